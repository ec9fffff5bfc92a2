"""The public API for plugin authors, which contains everything that a plugin needs.

The names in `__all__` keep their meaning within a minor version (see docs/plugins.md).
"""

from pydantic import Field

from crossgrad_core.contract import screen_statistics
from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    NO_EDIT,
    Block,
    BlockKind,
    Edit,
    Json,
    LearningRate,
    Parameters,
    PluginState,
    Rows,
    apply_to_parameters,
)
from crossgrad_core.contract.component import Component, ViewCounts, hookimpl
from crossgrad_core.contract.contexts import (
    AfterStepContext,
    AggregateContext,
    AggregateResult,
    Answer,
    BetweenSteps,
    DensifyContext,
    DensifyResult,
    EvaluationReport,
    Model,
    OperatorContext,
    PixelContext,
    RegularizeContext,
    RegularizeResult,
    RenderedView,
    RenderOnRequest,
    RequestedRender,
    RunInfo,
    SampleContext,
    SampleResult,
    ScaleContext,
    ScaleResult,
    StepContext,
    StepRecord,
    ViewRecord,
    ViewSample,
)
from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.figure import Figure
from crossgrad_core.contract.gaussians import Gaussians, Render, Response, Screen
from crossgrad_core.contract.georeference import (
    COORDINATES_TAG,
    INPUT,
    LOCAL,
    Georeference,
    Placed,
    Similarity,
    Unplaced,
)
from crossgrad_core.contract.gradients import Granularity, SeparateGradients
from crossgrad_core.contract.gramian_operator import (
    GramianOperator,
    MatrixOperator,
    Weighting,
    diagonals,
    transformed,
)
from crossgrad_core.contract.objections import objections_to_views, set_for_nothing
from crossgrad_core.contract.scene import (
    Camera,
    Photo,
    Pinhole,
    Scene,
    View,
    centers_of,
    footprint_of,
    is_in_image,
    masked,
    radial_distances,
    to_uint8,
    unit_range,
    without_rounding,
)
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.schedule import (
    REFERENCE,
    SHORTEST_ANCHOR_INTERVAL,
    Phase,
    Schedule,
    Unit,
    ViewsPerStepSpec,
    shortness,
)
from crossgrad_core.contract.selection import HasUnusedOptions, Selection
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.exporter import ExportContent, Exporter, Rounding
from crossgrad_core.contract.slots.exposure import Exposure, Fitted, PerPhoto
from crossgrad_core.contract.slots.grouping import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Quantity,
    Regrouping,
)
from crossgrad_core.contract.slots.initializer import Initializer, MorePoints
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.metric import Compared, Metric
from crossgrad_core.contract.slots.observer import Observer
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.contract.slots.reader import Reader
from crossgrad_core.contract.slots.recipe import Facts, Recipe, with_rows
from crossgrad_core.contract.slots.resolution import Resolution, octave
from crossgrad_core.contract.slots.rule import FinalEdit, GaussiansContext, GaussiansResult, Rule
from crossgrad_core.contract.slots.sampler import Sampler
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.evaluation.evaluation import psnr
from crossgrad_core.recipe.table import full_lines, short_lines, table_lines
from crossgrad_core.registry.entries import build as build_component
from crossgrad_core.registry.entries import entries as installed_plugins
from crossgrad_core.registry.entries import name_of as component_name
from crossgrad_core.registry.entries import plain as plain_component
from crossgrad_core.run.results.log import (
    Pace,
    evaluation_line,
    figures,
    length_lines,
    progress_line,
)
from crossgrad_core.scene.bimodality import ONE_MODE, bimodality
from crossgrad_core.system.files import atomic_file, atomic_folder, size_text
from crossgrad_core.system.input_files import is_file, open_file, read_file
from crossgrad_core.system.ply_table import read_vertices, vertex_properties
from crossgrad_core.system.terminal import controls_of, shows_bar
from crossgrad_core.system.text_files import read_json, read_rows
from crossgrad_core.wording import listed, showable

__all__ = [
    "COORDINATES_TAG",
    "EMPTY_STATE",
    "INPUT",
    "LOCAL",
    "NO_EDIT",
    "ONE_MODE",
    "REFERENCE",
    "SHORTEST_ANCHOR_INTERVAL",
    "AfterStepContext",
    "AggregateContext",
    "AggregateResult",
    "Answer",
    "Backbone",
    "BetweenSteps",
    "Block",
    "BlockKind",
    "Camera",
    "Compared",
    "Component",
    "Decision",
    "Densifier",
    "DensifyContext",
    "DensifyResult",
    "Edit",
    "EvaluationReport",
    "ExportContent",
    "Exporter",
    "Exposure",
    "Facts",
    "Field",
    "Figure",
    "FinalEdit",
    "Fitted",
    "Gaussians",
    "GaussiansContext",
    "GaussiansResult",
    "Georeference",
    "GradientProbe",
    "GramianOperator",
    "Granularity",
    "Grouping",
    "GroupingRule",
    "HasUnusedOptions",
    "IncompatibleSelectionError",
    "Initializer",
    "Json",
    "LearningRate",
    "Loss",
    "MatrixOperator",
    "Metric",
    "Model",
    "MorePoints",
    "Observer",
    "Operator",
    "OperatorContext",
    "Pace",
    "Parameters",
    "PerPhoto",
    "Phase",
    "Photo",
    "Pinhole",
    "PixelContext",
    "Placed",
    "PluginState",
    "Quantity",
    "Rasterizer",
    "Reader",
    "Recipe",
    "Regrouping",
    "RegularizeContext",
    "RegularizeResult",
    "Render",
    "RenderOnRequest",
    "RenderedView",
    "RequestedRender",
    "Resolution",
    "Response",
    "Rounding",
    "Rows",
    "Rule",
    "RunInfo",
    "SampleContext",
    "SampleResult",
    "Sampler",
    "ScaleContext",
    "ScaleResult",
    "Scene",
    "SceneOptions",
    "Schedule",
    "Screen",
    "Selection",
    "SeparateGradients",
    "Similarity",
    "StepContext",
    "StepRecord",
    "Unit",
    "Unplaced",
    "UserError",
    "View",
    "ViewCounts",
    "ViewRecord",
    "ViewSample",
    "ViewsPerStepSpec",
    "Weighting",
    "apply_to_parameters",
    "atomic_file",
    "atomic_folder",
    "bimodality",
    "build_component",
    "centers_of",
    "component_name",
    "controls_of",
    "diagonals",
    "evaluation_line",
    "figures",
    "footprint_of",
    "full_lines",
    "hookimpl",
    "installed_plugins",
    "is_file",
    "is_in_image",
    "length_lines",
    "listed",
    "masked",
    "objections_to_views",
    "octave",
    "open_file",
    "plain_component",
    "progress_line",
    "psnr",
    "radial_distances",
    "read_file",
    "read_json",
    "read_rows",
    "read_vertices",
    "screen_statistics",
    "set_for_nothing",
    "short_lines",
    "shortness",
    "showable",
    "shows_bar",
    "size_text",
    "table_lines",
    "to_uint8",
    "transformed",
    "unit_range",
    "vertex_properties",
    "with_rows",
    "without_rounding",
]
