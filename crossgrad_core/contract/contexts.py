"""Arguments and answers of the hooks."""

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
        labels: K group labels, or None where the sampler has no groups.
    """

    views: tuple[int, ...]
    labels: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedView:
    """A training view as it was rendered, beside what the render is compared with.

    Attributes:
        view: The view.
        camera: The camera that it was rendered with: that of the view in another size where `scale`
            is not 1.
        scale: Sides of the render over those of the photo as trained.
        gaussians: What was drawn.
        screen: Screen statistics in pixels of the render, gradients included where a backward pass
            has run; read in units of the full photo through `contract.screen_statistics`.
        image: [H, W, 3] the image that is compared: the render after exposure.
        photo: [H, W, 3] uint8 the photo that it is compared with, in the size of the render.
        mask: [H, W] bool, True where the pixel counts; None where every pixel does.
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
    """One rendered view of a step, after its backward pass, detached.

    Attributes:
        index: Position in `scene.train_views`.
        label: Its group label, or None.
        loss: Its own photometric loss.
        background: [3] RGB that it was drawn over.
    """

    index: int
    label: str | None
    loss: float
    background: Tensor


@dataclass(frozen=True)
class StepRecord:
    """The record of a step; observers see it, samplers see the last one.

    Attributes:
        step: 1-based number of the step.
        views: Positions in `scene.train_views`.
        names: Their names.
        labels: Their group labels, or None.
        losses: Their photometric losses, in order.
        primitives: Number after the step.
        counts: Counted events: `zero`, `disjoint`, `dropped`, `conflict` blocks of the aggregation,
            `cloned`, `split`, `pruned`, `reset` primitives of the densification.
        train_seconds: Training seconds since the start of the run, this step included.
        scales: The scales at which the views were rendered and compared; empty where all had their
            full size.
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


#: The photo [H, W, 3] uint8 of a view and its mask [H, W] bool, None where every pixel counts.
PhotoOf = Callable[[View], tuple[Tensor, Tensor | None]]


def decoded(view: View) -> tuple[Tensor, Tensor | None]:
    """The photo and the mask of a view, decoded off any clock."""
    return view.photo.image(), view.photo.mask()


@dataclass(frozen=True, eq=False, kw_only=True)
class RequestedRender(RenderedView):
    """A training view as it was rendered on request, through the run's exposure and loss.

    Attributes:
        render: What the rasterizer made of it.
        measure: Works out `loss`.
    """

    render: Render
    measure: Callable[[], Tensor]

    @cached_property
    def loss(self) -> Tensor:
        """The run's photometric loss, pixel weights included; worked out when it is asked for."""
        return self.measure()


class RenderOnRequest(Protocol):
    """Renders training views with the parameters as they are now."""

    def __call__(
        self,
        view: int,
        scale: float = 1.0,
        outputs: frozenset[str] = frozenset(),
        background: Tensor | None = None,
    ) -> RequestedRender:
        """The view as rendered.

        The render is part of a graph where gradients are on (`torch.enable_grad()`); a densifier
        that needs none asks under `torch.no_grad()`.

        Args:
            view: Position in `scene.train_views`.
            scale: In (0, 1]: sides of the render over those of the photo.
            outputs: Optional outputs of the rasterizer.
            background: [3] RGB; None takes that of evaluated views.
        """
        ...


def no_renders(*_asked: object, **_named: object) -> RequestedRender:
    """Stands where nothing can be rendered; raises RuntimeError."""
    raise RuntimeError("this context belongs to no run: there is nothing to render views with")


#: A view and its render [H, W, 3] -> the image as the view's camera would have taken it.
ExposedBy = Callable[[View, Tensor], Tensor]


def unexposed(_view: View, image: Tensor) -> Tensor:
    """The image as it is."""
    return image


@dataclass(frozen=True, eq=False)
class StepContext:
    """The context of a step, common to all hooks.

    Attributes:
        step: 1-based number of the step.
        schedule: The schedule of the run.
        scene: The scene.
        states: State of every plugin by the plugin's name; read only.
        rng: The generator of the hook. Every random number of a plugin must come from it.
        photo: Gives the photo and the mask of a view on the run's device. The time for decoding
            them counts as loading; `view.photo` would decode them in training time.
    """

    step: int
    schedule: Schedule
    scene: Scene
    states: Mapping[str, PluginState]
    rng: np.random.Generator
    photo: PhotoOf = field(default=decoded, kw_only=True)

    def state(self, plugin: str) -> PluginState:
        """The state that the plugin of that name returned last; empty at first."""
        return self.states.get(plugin, EMPTY_STATE)


@dataclass(frozen=True, eq=False)
class SampleContext(StepContext):
    """For `crossgrad_sample_views`.

    Attributes:
        views_per_step: K of this step.
        groups: Label of each training view, or None where no grouping was made.
        centers: [N, 3] float64 camera centres of the training views, local frame.
        last: Record of the step before, None in the first one.
    """

    views_per_step: int
    groups: tuple[str, ...] | None
    centers: NDArray[np.float64]
    last: StepRecord | None


@dataclass(frozen=True, eq=False)
class ScaleContext(StepContext):
    """For `crossgrad_choose_scales`.

    Attributes:
        draw: The views of the step.
        last: Record of the step before, None in the first one.
    """

    draw: ViewSample
    last: StepRecord | None

    @property
    def views(self) -> tuple[View, ...]:
        """The views of the step."""
        return tuple(self.scene.train_views[index] for index in self.draw.views)


@dataclass(frozen=True, eq=False)
class PixelContext(StepContext):
    """For `crossgrad_pixel_weights`.

    Attributes:
        index: Position of the view in `scene.train_views`.
        view: The view.
        camera: The camera that it is rendered with.
        scale: Sides of the render over those of the photo as trained.
        target: [H, W, 3] uint8 the photo that the render is compared with, in its size.
        mask: [H, W] bool, True where the pixel counts; None where every pixel counts.
    """

    index: int
    view: View
    camera: Camera
    scale: float
    target: Tensor
    mask: Tensor | None


@dataclass(frozen=True, eq=False)
class AggregateContext(StepContext):
    """For `crossgrad_aggregate_gradients`.

    Attributes:
        gradients: The gradients of the K views: apart where the operator or a plugin asks for it.
        losses: [K] float64 photometric losses.
        labels: K group labels, or None.
        distances: [K] float64 distance of each camera from the mean training camera, local units.
        reference_distance: Median of these distances over all training cameras.
        blocks: The blocks, in the order of every Gramian's first dimension.
        scales: K scales at which losses and gradients were taken; empty where all are 1.
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
        """The gradients, of each view by itself.

        Raises:
            TypeError: They were accumulated, because no plugin said that single views matter.
        """
        if isinstance(self.gradients, SeparateGradients):
            return self.gradients
        raise TypeError(
            "the views' gradients were accumulated and only their sum is known; an operator or "
            "plugin that looks at single views must say so with `separate = True`"
        )


@dataclass(frozen=True, eq=False)
class RegularizeContext(StepContext):
    """For `crossgrad_regularize`: called once per view, and once per step with `gaussians` None.

    Attributes:
        parameters: The parameters, requiring gradients.
        backbone: The backbone.
        gaussians: What the backbone decoded for this view, with its graph; None in the step's call.
        view: The view; None in the step's call.
    """

    parameters: Mapping[str, Tensor]
    backbone: "Backbone"
    gaussians: Gaussians | None
    view: View | None


@dataclass(frozen=True, eq=False)
class DensifyContext(StepContext):
    """For `crossgrad_densify`, called after every step.

    Attributes:
        parameters: The parameters; to be changed through the answered edit only.
        backbone: The backbone.
        rasterizer: The rasterizer, for statistics of views that this step did not render.
        views: The rendered views of the step with their screen statistics.
        share: Number of these over that of all views of the step; 1 but for `--densify-views`.
        means_lr: Current learning rate of the primitives' positions.
        room: How many primitives may still be added (`--max-gaussians`, memory guard).
        may_grow: [P] bool, the primitives that may grow; None where all may.
        render: Renders a training view of the densifier's choice: on the training clock, and
            counted among the rendered views.
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
    """For `crossgrad_after_optimizer`, `crossgrad_after_step` and `crossgrad_step_done`.

    Attributes:
        parameters: The parameters; to be changed through the answered edit only.
        backbone: The backbone.
        means_lr: Current learning rate of the primitives' positions.
        edited: Whether density control changed the set of primitives in this step already.
    """

    parameters: Mapping[str, Tensor]
    backbone: "Backbone"
    means_lr: float
    edited: bool


@dataclass(frozen=True)
class Answer:
    """The part common to the answers of all hooks: new states by plugin name."""

    states: Mapping[str, PluginState] = field(default_factory=dict, kw_only=True)

    def with_state(self, plugin: str, state: PluginState) -> Self:
        """The same answer with a new state for the plugin of that name."""
        return replace(self, states={**self.states, plugin: state})


@dataclass(frozen=True)
class SampleResult(Answer):
    """Answer of `crossgrad_sample_views`."""

    draw: ViewSample


@dataclass(frozen=True)
class ScaleResult(Answer):
    """Answer of `crossgrad_choose_scales`: one scale in (0, 1] for each drawn view."""

    scales: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class AggregateResult(Answer):
    """Answer of `crossgrad_aggregate_gradients`.

    Attributes:
        gradients: Tensor name -> gradient, None where the optimizer must skip the tensor.
        counts: Counted events of this step.
    """

    gradients: Mapping[str, Tensor | None]
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RegularizeResult(Answer):
    """Answer of `crossgrad_regularize`: a scalar to be minimised besides the photometric loss."""

    loss: Tensor


@dataclass(frozen=True, eq=False)
class DensifyResult(Answer):
    """Answer of the hooks that edit primitives, such as `crossgrad_densify`: may be NO_EDIT."""

    edit: Edit


@dataclass(frozen=True, eq=False)
class RunInfo:
    """The run at its start, for observers.

    Attributes:
        folder: The output folder; None where nothing is written.
        scene: The scene.
        config: The resolved configuration as plain data.
        schedule: The schedule.
        blocks: The blocks of the backbone.
        notes: What was chosen or left out, and why.
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
    """The model between two steps, for those who measure it. Nothing in it may be changed.

    Attributes:
        phase: The moment, as training decodes in it; `phase.step` is the last complete step.
        scene: The scene.
        backbone: The backbone.
        rasterizer: The rasterizer.
        parameters: The parameters.
        adam: The optimizer's moments.
        rule: How Adam averages in the next step.
        background: [3] RGB that evaluated views are drawn over.
        loss: The photometric loss.
        groups: Group label of each training view, or None.
        exposed: What the run's exposure makes of a render [H, W, 3] of a view; it goes before the
            loss.
        render: Renders a training view of the observer's choice; off the clock, and not counted.
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
    """An evaluation, for observers.

    Attributes:
        step: The step.
        row: The new row of metrics.csv.
        regimes: The regimes of the held-out views; `psnr_far` is the PSNR of regime `far`.
    """

    step: int
    row: Mapping[str, float | int | str | None]
    regimes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class OperatorContext:
    """The context of a Gramian operator, besides the Gramians.

    Attributes:
        step: 1-based number of the step.
        blocks: [B] name of each Gramian's block (`geometry`, `appearance` under granularity
            `kind`, `all` under `global`; under `gaussian` one name for all rows of a block).
        kinds: [B] kind of each.
        losses: [K] float64.
        labels: K group labels, or None.
        distances: [K] float64 camera distances from the mean training camera, local units.
        reference_distance: Their median over all training cameras.
        present: [B, K] bool, views whose gradient of the block is finite and not zero. The rows and
            columns of the others are zero in the Gramian; an operator must give them weight 0.
        unit: Unit roundoff of the gradients' type: no result needs to be closer.
        rounding_residuals: Works out [B, K, K], what rounding to float64 took from the Gramians.
            Both together have twice the digits. It takes another, slower pass over the gradients,
            for Gramians so close to singular that their own rounding shows. None if unknown.
        scales: K scales at which losses and gradients were taken; empty where all are 1.
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
