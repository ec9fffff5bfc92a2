"""Arguments and results of the hooks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    AdamRule,
    AdamState,
    Block,
    BlockKind,
    Edit,
    Parameters,
    PluginState,
)
from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.gaussians import Gaussians, Render, Screen
from crossgrad_core.contract.gradients import Gradients, SeparateGradients
from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.contract.schedule import Phase, Schedule

if TYPE_CHECKING:
    from crossgrad_core.contract.slots.backbone import Backbone
    from crossgrad_core.contract.slots.loss import Loss
    from crossgrad_core.contract.slots.rasterizer import Rasterizer


@dataclass(frozen=True)
class ViewSample:
    """The views of one step.

    Attributes:
        views: K positions in `scene.train_views`.
        labels: K group labels, or None if the sampler uses no groups.
    """

    views: tuple[int, ...]
    labels: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedView:
    """A rendered training view, together with the photo that the render is compared with.

    Attributes:
        view: The view.
        camera: The camera of the render: the view's camera, resized if `scale` is not 1.
        scale: Side length of the render divided by the side length of the photo at training
            resolution.
        gaussians: The Gaussians that were rendered.
        screen: Screen statistics in pixels of the render, with gradients if a backward pass has
            run. `contract.screen_statistics` converts the statistics to units of the full photo.
        image: [H, W, 3] the render after the exposure model; the loss compares this image with the
            photo.
        photo: [H, W, 3] uint8 photo, in the size of the render.
        mask: [H, W] bool, True where the pixel counts; None if every pixel counts.
    """

    view: View
    camera: Camera
    scale: float
    gaussians: Gaussians
    screen: Screen
    image: Tensor
    photo: Tensor
    mask: Tensor | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewRecord(RenderedView):
    """One rendered view of a step after its backward pass; its tensors are detached.

    Attributes:
        index: Position in `scene.train_views`.
        label: Group label of the view; None without groups. loss: Photometric loss of this view.
        background: [3] RGB background of the render.
    """

    index: int
    label: str | None
    loss: float
    background: Tensor


@dataclass(frozen=True)
class StepRecord:
    """The record of a step.

    Observers receive this record; samplers receive the record of the previous step.

    Attributes:
        step: 1-based number of the step.
        views: Positions in `scene.train_views`.
        names: Names of the views.
        labels: Group labels of the views; None without groups.
        losses: Photometric losses of the views, in the order of `views`.
        primitives: Number of primitives after the step.
        counts: Event -> number. The aggregation counts blocks: `zero`, `disjoint`, `dropped`,
            `conflict`. The densification counts primitives: `cloned`, `split`, `pruned`, `reset`.
        train_seconds: Training seconds since the start of the run, this step included.
        scales: The scales at which the views were rendered; empty if all views had their full size.
    """

    step: int
    views: tuple[int, ...]
    names: tuple[str, ...]
    labels: tuple[str, ...] | None
    losses: tuple[float, ...]
    primitives: int
    counts: Mapping[str, int]
    train_seconds: float
    scales: tuple[float, ...] = ()


#: View -> its photo [H, W, 3] uint8 and its mask [H, W] bool (None if every pixel counts).
PhotoOf = Callable[[View], tuple[Tensor, Tensor | None]]


def decoded(view: View) -> tuple[Tensor, Tensor | None]:
    """Return the decoded photo and mask of a view; the decoding time is not measured."""
    return view.photo.image(), view.photo.mask()


@dataclass(frozen=True, eq=False, kw_only=True)
class RequestedRender(RenderedView):
    """A training view that a plugin requested, rendered with the run's exposure and loss.

    Attributes:
        render: The output of the rasterizer.
        measure: Computes `loss`.
    """

    render: Render
    measure: Callable[[], Tensor]

    @cached_property
    def loss(self) -> Tensor:
        """The run's photometric loss, including pixel weights; computed at first access."""
        return self.measure()


class RenderOnRequest(Protocol):
    """A function that renders training views with the present parameters."""

    def __call__(
        self,
        view: int,
        scale: float = 1.0,
        outputs: frozenset[str] = frozenset(),
        background: Tensor | None = None,
    ) -> RequestedRender:
        """Return the rendered view.

        The render is part of an autograd graph if gradients are enabled (`torch.enable_grad()`). A
        densifier that needs no gradients calls this function under `torch.no_grad()`.

        Args:
            view: Position in `scene.train_views`.
            scale: Side length of the render divided by the side length of the photo, in (0, 1].
            outputs: Optional outputs of the rasterizer.
            background: [3] RGB; None uses the background of evaluated views.
        """
        ...


def no_renders(*_asked: object, **_named: object) -> RequestedRender:
    """Raise a RuntimeError; this is the default for contexts that cannot render views."""
    raise RuntimeError("views cannot be rendered: this context does not belong to a run")


#: A view and its render [H, W, 3] -> the image as the camera of the view would have recorded it.
ExposedBy = Callable[[View, Tensor], Tensor]


def unexposed(_view: View, image: Tensor) -> Tensor:
    """Return the image unchanged."""
    return image


@dataclass(frozen=True, eq=False)
class StepContext:
    """The context of a step, common to all hooks.

    Attributes:
        step: 1-based number of the step.
        schedule: The schedule of the run.
        scene: The scene.
        states: Plugin name -> state of the plugin; read only.
        rng: The random generator of the hook. Every random number of a plugin must come from this
            generator.
        photo: Returns the photo and the mask of a view on the run's device. The decoding time then
            counts as loading time. If a plugin uses `view.photo` instead, the decoding time counts
            as training time.
    """

    step: int
    schedule: Schedule
    scene: Scene
    states: Mapping[str, PluginState]
    rng: np.random.Generator
    photo: PhotoOf = field(default=decoded, kw_only=True)

    def state(self, plugin: str) -> PluginState:
        """Return the last state of the plugin with this name; empty before its first state."""
        return self.states.get(plugin, EMPTY_STATE)


@dataclass(frozen=True, eq=False)
class SampleContext(StepContext):
    """The context of `crossgrad_sample_views`.

    Attributes:
        views_per_step: Number of views of this step, K.
        groups: Label of each training view, or None if the run has no grouping.
        centers: [N, 3] float64 camera centres of the training views, local frame.
        last: Record of the previous step; None in the first step.
    """

    views_per_step: int
    groups: tuple[str, ...] | None
    centers: NDArray[np.float64]
    last: StepRecord | None


@dataclass(frozen=True, eq=False)
class ScaleContext(StepContext):
    """The context of `crossgrad_choose_scales`.

    Attributes:
        draw: The views of the step.
        last: Record of the previous step; None in the first step.
    """

    draw: ViewSample
    last: StepRecord | None

    @property
    def views(self) -> tuple[View, ...]:
        """The views of the step."""
        return tuple(self.scene.train_views[index] for index in self.draw.views)


@dataclass(frozen=True, eq=False)
class PixelContext(StepContext):
    """The context of `crossgrad_pixel_weights`.

    Attributes:
        index: Position of the view in `scene.train_views`.
        view: The view.
        camera: The camera of the render.
        scale: Side length of the render divided by the side length of the photo at training
            resolution.
        target: [H, W, 3] uint8 photo that the render is compared with, in the size of the render.
        mask: [H, W] bool, True where the pixel counts; None if every pixel counts.
    """

    index: int
    view: View
    camera: Camera
    scale: float
    target: Tensor
    mask: Tensor | None


@dataclass(frozen=True, eq=False)
class AggregateContext(StepContext):
    """The context of `crossgrad_aggregate_gradients`.

    Attributes:
        gradients: The gradients of the K views; separate if the operator or a plugin requires
            separate gradients.
        losses: [K] float64 photometric losses.
        labels: K group labels; None without groups.
        distances: [K] float64 distance of each camera from the mean position of the training
            cameras, local units.
        reference_distance: Median distance of the training cameras from their mean position, local
            units.
        blocks: The blocks, in the order of the first dimension of arrays such as [B, K, K].
        scales: K scales at which losses and gradients were computed; empty if all are 1.
    """

    gradients: Gradients
    losses: NDArray[np.float64]
    labels: tuple[str, ...] | None
    distances: NDArray[np.float64]
    reference_distance: float
    blocks: tuple[Block, ...]
    scales: tuple[float, ...] = field(default=(), kw_only=True)

    @property
    def separate(self) -> SeparateGradients:
        """The gradients of each view, kept separate.

        Raises:
            TypeError: The gradients were accumulated because no plugin requires separate gradients.
        """
        if isinstance(self.gradients, SeparateGradients):
            return self.gradients
        raise TypeError(
            "the gradients of the views were summed during accumulation, so the gradient "
            "of a single view is not available; an operator or plugin that reads single "
            "views must declare `separate = True`"
        )


@dataclass(frozen=True, eq=False)
class RegularizeContext(StepContext):
    """The context of `crossgrad_regularize`.

    Attributes:
        parameters: The parameters, which require gradients.
        backbone: The backbone.
        gaussians: The Gaussians that the backbone decoded for this view, with their autograd graph;
            None if the hook is called for the whole step.
        view: The view; None if the hook is called for the whole step.
    """

    parameters: Mapping[str, Tensor]
    backbone: "Backbone"
    gaussians: Gaussians | None
    view: View | None


@dataclass(frozen=True, eq=False)
class DensifyContext(StepContext):
    """The context of `crossgrad_densify`, which is called after every step.

    Attributes:
        parameters: The parameters. Only the returned edit may change the parameters.
        backbone: The backbone.
        rasterizer: The rasterizer, for statistics of views that this step did not render.
        views: The rendered views of the step with their screen statistics.
        share: Number of `views` divided by the number of all views of the step; the quotient is 1
            unless the user sets `--densify-views`.
        means_lr: Current learning rate of the primitives' positions.
        room: Number of primitives that may still be added (`--max-gaussians`, memory guard).
        may_grow: [P] bool, True for primitives that may be cloned or split; None if all primitives
            may.
        render: Renders a training view that the densifier chooses. The render counts as training
            time and as a rendered view.
    """

    parameters: Mapping[str, Tensor]
    backbone: "Backbone"
    rasterizer: "Rasterizer"
    views: tuple[ViewRecord, ...]
    means_lr: float
    room: int
    render: RenderOnRequest = field(default=no_renders, kw_only=True)
    share: float = field(default=1.0, kw_only=True)
    may_grow: Tensor | None = field(default=None, kw_only=True)


@dataclass(frozen=True, eq=False)
class AfterStepContext(StepContext):
    """The context of the hooks `crossgrad_after_optimizer`, `_after_step` and `_step_done`.

    Attributes:
        parameters: The parameters. Only the returned edit may change the parameters.
        backbone: The backbone.
        means_lr: Current learning rate of the primitives' positions.
        edited: True if density control has already changed the set of primitives in this step.
    """

    parameters: Mapping[str, Tensor]
    backbone: "Backbone"
    means_lr: float
    edited: bool


@dataclass(frozen=True)
class Answer:
    """The common part of the results of all hooks: new states by plugin name."""

    states: Mapping[str, PluginState] = field(default_factory=dict, kw_only=True)

    def with_state(self, plugin: str, state: PluginState) -> Self:
        """Return this result with a new state of the plugin with this name."""
        return replace(self, states={**self.states, plugin: state})


@dataclass(frozen=True)
class SampleResult(Answer):
    """Result of `crossgrad_sample_views`."""

    draw: ViewSample


@dataclass(frozen=True)
class ScaleResult(Answer):
    """Result of `crossgrad_choose_scales`: one scale in (0, 1] for each drawn view."""

    scales: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class AggregateResult(Answer):
    """Result of `crossgrad_aggregate_gradients`.

    Attributes:
        gradients: Tensor name -> gradient; None if the optimizer must skip the tensor.
        counts: Event -> number of occurrences in this step.
    """

    gradients: Mapping[str, Tensor | None]
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RegularizeResult(Answer):
    """Result of `crossgrad_regularize`: a scalar to add to the photometric loss."""

    loss: Tensor


@dataclass(frozen=True, eq=False)
class DensifyResult(Answer):
    """Result of the hooks that edit primitives, such as `crossgrad_densify`; may be NO_EDIT."""

    edit: Edit


@dataclass(frozen=True, eq=False)
class RunInfo:
    """The facts about a run at its start, for observers.

    Attributes:
        folder: The output folder; None if nothing is written.
        scene: The scene.
        config: The resolved configuration as plain data.
        schedule: The schedule.
        blocks: The blocks of the backbone.
        notes: Messages about the run's choices, with reasons.
        decisions: The table of decided settings.
    """

    folder: Path | None
    scene: Scene
    config: Mapping[str, Any]
    schedule: Schedule
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, eq=False)
class Model:
    """The model between two steps, for plugins that measure it.

    Plugins must not change this object or its tensors.

    Attributes:
        phase: The phase that the backbone needs to decode the Gaussians; `phase.step` is the last
            complete step.
        scene: The scene.
        backbone: The backbone.
        rasterizer: The rasterizer.
        parameters: The parameters.
        adam: The optimizer's moments.
        rule: The hyperparameters of Adam's moments in the next step.
        background: [3] RGB background of evaluated views.
        loss: The photometric loss.
        groups: Group label of each training view; None without groups.
        exposed: Applies the run's exposure to a render [H, W, 3] of a view, before the loss.
        render: Renders a training view that the observer chooses. The render counts neither as
            training time nor as a rendered view.
    """

    phase: Phase
    scene: Scene
    backbone: "Backbone"
    rasterizer: "Rasterizer"
    parameters: Parameters
    adam: AdamState
    background: Tensor
    loss: "Loss"
    groups: tuple[str, ...] | None
    exposed: ExposedBy = field(default=unexposed)
    rule: AdamRule = field(default=AdamRule())
    render: RenderOnRequest = field(default=no_renders)


@dataclass(frozen=True)
class EvaluationReport:
    """The results of one evaluation, for observers.

    Attributes:
        step: Step after which the views were evaluated.
        row: The new row of metrics.csv.
        regimes: The regimes of the held-out views. For example, column `psnr_far` is the PSNR of
            regime `far`.
    """

    step: int
    row: Mapping[str, float | int | str | None]
    regimes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class OperatorContext:
    """The context of a Gramian operator, in addition to the Gramians.

    Attributes:
        step: 1-based number of the step.
        blocks: [B] name of the block that each Gramian belongs to. With granularity `kind`, the
            names are kinds such as `geometry`; with `global`, the only name is `all`. With
            `gaussian`, all Gramians of a block have the block's name.
        kinds: [B] kind of each block.
        losses: [K] float64 photometric losses.
        labels: K group labels; None without groups.
        distances: [K] float64 distance of each camera from the mean position of the training
            cameras, local units.
        reference_distance: Median distance of the training cameras from their mean position, local
            units.
        present: [B, K] bool, views whose gradient of the block is finite and not zero. For a view
            with the value False, the row and column of the Gramian are zero, and the operator must
            return weight 0.
        unit: Unit roundoff of the gradients' type. Results need not be more accurate than the unit
            roundoff.
        rounding_residuals: Computes [B, K, K], the parts of the Gramians that rounding to float64
            removed. The sum of Gramian and residual has twice as many correct digits. The
            computation needs another, slower pass over the gradients. Use the residuals only for
            Gramians that are almost singular, because rounding then affects the result. None if no
            residuals can be computed.
        scales: K scales at which losses and gradients were computed; empty if all are 1.
    """

    step: int
    blocks: tuple[str, ...]
    kinds: tuple[BlockKind, ...]
    losses: NDArray[np.float64]
    labels: tuple[str, ...] | None
    distances: NDArray[np.float64]
    reference_distance: float
    present: NDArray[np.bool_]
    unit: float = 2.0**-24
    rounding_residuals: Callable[[], NDArray[np.float64]] | None = None
    scales: tuple[float, ...] = ()
