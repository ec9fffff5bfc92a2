"""The public interface for authors of plugins: everything that a plugin needs, from one place.

Names that are listed here keep their meaning within a minor version; see docs/plugins.md.
"""

from pydantic import Field

from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.blocks import Block, BlockKind, LearningRate, Parameters
from crossgrad_core.contract.component import Component, ViewCounts
from crossgrad_core.contract.contexts import (
    AfterStepContext,
    AggregateContext,
    Aggregated,
    Densified,
    DensifyContext,
    Draw,
    EvaluationReport,
    Model,
    OperatorContext,
    RegularizeContext,
    Regularized,
    RunInfo,
    SampleContext,
    Sampled,
    StepContext,
    StepRecord,
    ViewRecord,
)
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.gaussians import Gaussians, Render, Response, Screen
from crossgrad_core.contract.gradients import Granularity, SeparateGradients
from crossgrad_core.contract.gramian_operator import GramianOperator, MatrixOperator, Weighting
from crossgrad_core.contract.grouping import GradientProbe, Grouping, Quantity, Rule
from crossgrad_core.contract.marks import hookimpl
from crossgrad_core.contract.observer import Observer
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.reader import Reader
from crossgrad_core.contract.sampler import Sampler
from crossgrad_core.contract.scene import Camera, Photo, Scene, Similarity, View
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.contract.selection import HasIdleOptions, Selection
from crossgrad_core.contract.state import EMPTY_STATE, PluginState
from crossgrad_core.contract.topology import NO_EDIT, Edit, Rows
from crossgrad_core.errors import IncompatibleSelectionError, UserError

__all__ = [
    "EMPTY_STATE",
    "NO_EDIT",
    "AfterStepContext",
    "AggregateContext",
    "Aggregated",
    "Backbone",
    "Block",
    "BlockKind",
    "Camera",
    "Component",
    "Densified",
    "Densifier",
    "DensifyContext",
    "Draw",
    "Edit",
    "EvaluationReport",
    "Field",
    "Gaussians",
    "GradientProbe",
    "GramianOperator",
    "Granularity",
    "Grouping",
    "HasIdleOptions",
    "IncompatibleSelectionError",
    "LearningRate",
    "MatrixOperator",
    "Model",
    "Observer",
    "Operator",
    "OperatorContext",
    "Parameters",
    "Phase",
    "Photo",
    "PluginState",
    "Quantity",
    "Rasterizer",
    "Reader",
    "RegularizeContext",
    "Regularized",
    "Render",
    "Response",
    "Rows",
    "Rule",
    "RunInfo",
    "SampleContext",
    "Sampled",
    "Sampler",
    "Scene",
    "SceneOptions",
    "Schedule",
    "Screen",
    "Selection",
    "SeparateGradients",
    "Similarity",
    "StepContext",
    "StepRecord",
    "UserError",
    "View",
    "ViewCounts",
    "ViewRecord",
    "Weighting",
    "hookimpl",
]
