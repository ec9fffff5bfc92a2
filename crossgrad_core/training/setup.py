"""The setup of a run after its configuration is resolved. Training does not change the setup."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from typing import Any

import numpy as np
import pluggy
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import EMPTY_STATE, Block
from crossgrad_core.contract.contexts import AggregateContext
from crossgrad_core.contract.decision import FOLLOWING, Decide, Decision, Length, repeats
from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.contract.selection import Selection
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.exposure import Exposure, PerPhoto
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.metric import Metric
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.contract.slots.rule import Rule
from crossgrad_core.contract.slots.sampler import Sampler
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.numerics.hashing import hash32
from crossgrad_core.registry.manager import make_manager, one_by_one, wrong_answer
from crossgrad_core.scene.photos.photos_ahead import PhotosAhead
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.scaled_photos import DevicePhotos, ScaledPhotos


def learns_in(step: int, every: int) -> bool:
    """Return True if a tensor that is updated once in `every` steps is updated in this step.

    A hash function chooses one step of each `every` steps. With a fixed interval, a sampler that
    cycles through photos or regimes could always skip some photos or regimes.
    """
    turn, offset = divmod(step - 1, every)
    return offset == hash32(turn) * every >> 32


@dataclass(frozen=True)
class Scale:
    """The scale of an operator's result for K views, by tensor name.

    Attributes:
        per_step: c(K), the factor of the operator for K equal gradients. The factor is K for a sum
            and 1 for a mean.
        per_view: c(K) / K.
        to_sum: K / |c(K)|, a factor that makes the result as large as the sum of the views'
            gradients. Adam receives the scaled result, because eps and the numerical limits of Adam
            are absolute.
    """

    per_step: Mapping[str, float]
    per_view: Mapping[str, float]
    to_sum: Mapping[str, float]

    @classmethod
    def of(cls, sums: Mapping[str, float], views: int) -> "Scale":
        """Return the scale for K = `views`.

        `sums` contains the operator's factors c(K), by tensor name.
        """
        shares = {name: value / views for name, value in sums.items()}
        # If an operator returns zero for equal gradients, its result cannot be scaled; use a factor
        # of 1.
        to_sum = {name: 1.0 / (abs(share) or 1.0) for name, share in shares.items()}
        return cls(sums, shares, to_sum)


class OperatorScale:
    """The factors c(K): the sum of an operator's weights for K equal gradients.

    The operator is called once for each combination of K and labels. In this call, the operator
    receives K equal gradients with one element per tensor, and an empty state. In this call, the
    views differ only in their labels. The measurement works for every operator, also for chains,
    plugins, and operators that act on blocks or elements.

    Args:
        operator: The operator to measure.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._known: dict[tuple[int, tuple[str, ...] | None], Scale] = {}

    def of(self, context: AggregateContext) -> Scale:
        """Return the scale for the number of views and the labels of this step.

        Raises:
            UserError: The operator's result for equal gradients is not finite.
        """
        key = (len(context.losses), context.labels)
        if key not in self._known:
            self._known[key] = Scale.of(self._asked(neutral(context)), len(context.losses))
        return self._known[key]

    def _asked(self, context: AggregateContext) -> dict[str, float]:
        answer, _ = self._operator.aggregate(context, EMPTY_STATE)
        sums = {}
        for name in (name for block in context.blocks for name in block.tensors):
            gradient = answer.gradients.get(name)
            sums[name] = 0.0 if gradient is None else float(gradient.sum())
            if not isfinite(sums[name]):
                raise self._not_finite(name, len(context.losses))
        return sums

    def _not_finite(self, name: str, views: int) -> UserError:
        return UserError(
            f"operator {type(self._operator).__name__} returned a weight that is not "
            f"finite for {views} equal gradients",
            where=f"block of {name}",
            expected="finite weights for finite gradients",
            todo="use another operator, or report this to the operator's author",
        )


def neutral(context: AggregateContext) -> AggregateContext:
    """Return an artificial context of step 1.

    The K views of the context have equal gradients, losses, distances and image sizes.
    """
    views = len(context.losses)
    names = [name for block in context.blocks for name in block.tensors]
    unit = {name: torch.ones(1, dtype=torch.float64) for name in names}
    return replace(
        context,
        step=1,
        states={},
        rng=np.random.default_rng(0),
        gradients=DenseGradients([unit] * views, context.blocks),
        losses=np.ones(views),
        distances=np.full(views, context.reference_distance),
        scales=(1.0,) * views,
    )


@dataclass(frozen=True, eq=False)
class Setup:
    """The resolved components and settings of a run.

    Attributes:
        config: The configuration, including all decisions.
        scene: The scene.
        selection: The selected components.
        manager: The plugin manager of this run.
        plugins: All registered plugins, by name.
        groups: Label of each training view; None without a grouping.
        schedule: The schedule of the run.
        device: The device of the tensors.
        notes: Messages to the user about choices and omissions, with reasons.
        scaled_photos: The cache of reduced photos, or of photos on the GPU.
        photos_ahead: The threads that decode photos while steps run.
        decisions: The decided settings, with their reasons.
        decide: Function that decides the settings for another length. If a run repeats another run,
            the function decides nothing.
        revised: Settings that changed when the time budget changed the length of the run.
        pixel_share: Measured share of the time of a full-size step that is proportional to the
            number of pixels.
    """

    config: RunConfig
    scene: Scene
    selection: Selection
    manager: pluggy.PluginManager
    plugins: Mapping[str, object]
    groups: tuple[str, ...] | None
    schedule: Schedule
    device: torch.device
    notes: tuple[str, ...]
    scaled_photos: ScaledPhotos | DevicePhotos
    photos_ahead: PhotosAhead = field(default_factory=PhotosAhead)
    decisions: tuple[Decision, ...] = ()
    decide: Decide = repeats
    revised: Mapping[str, Any] = field(default_factory=dict)
    pixel_share: float = 0.6

    @cached_property
    def in_force(self) -> RunConfig:
        """The configuration with the settings that are valid at the present length of the run."""
        return self.config.model_copy(update=dict(self.revised))

    @cached_property
    def numbers(self) -> Numbers:
        """The decided settings that training uses."""
        return Numbers.of(self.in_force)

    def following(self, steps: int, start: int | None) -> dict[str, Any]:
        """Return the settings that depend on the length, for a total of `steps` steps.

        Args:
            steps: Total number of steps of the run.
            start: Number of primitives at the start; None if the primitives have not been counted
                yet.
        """
        rows = self.decide(Length(self.config.steps or steps, steps, start))
        return {row.setting: row.value for row in rows if row.setting in FOLLOWING}

    def at_length(self, steps: int, start: int | None) -> "Setup":
        """Return the setup of the run with the settings for another length."""
        return replace(self, revised={**self.revised, **self.following(steps, start)})

    def with_rules(self, rules: Mapping[str, Rule]) -> "Setup":
        """Return the setup of the run with `rules` in place of its present rules."""
        if rules == self.selection.rules:
            return self
        others = {n: plugin for n, plugin in self.plugins.items() if not isinstance(plugin, Rule)}
        selection = replace(self.selection, rules=rules)
        plugins = {**selection.plugins, **others}
        return replace(self, selection=selection, manager=make_manager(plugins), plugins=plugins)

    @property
    def backbone(self) -> Backbone:
        """The selected backbone."""
        return self.selection.backbone

    @property
    def sampler(self) -> Sampler:
        """The selected sampler."""
        return self.selection.sampler

    @property
    def operator(self) -> Operator:
        """The selected operator."""
        return self.selection.operator

    @property
    def densifier(self) -> Densifier:
        """The selected densifier."""
        return self.selection.densifier

    @property
    def rasterizer(self) -> Rasterizer:
        """The selected rasterizer."""
        return self.selection.rasterizer

    @property
    def loss(self) -> Loss:
        """The selected photometric loss."""
        return self.selection.loss

    @property
    def exposure(self) -> Exposure:
        """The selected exposure model, which describes brightness and color changes of a camera."""
        return self.selection.exposure

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The selected metrics for held-out views."""
        return tuple(self.selection.metrics.values())

    @cached_property
    def hook(self) -> pluggy.HookRelay:
        """The hook relay that calls the plugins of this run."""
        return self.manager.hook

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks of the backbone's parameters."""
        return self.backbone.blocks()

    @cached_property
    def trained_blocks(self) -> tuple[Block, ...]:
        """The blocks whose tensors receive gradients."""
        return self.backbone.trained_blocks()

    @cached_property
    def train_views(self) -> tuple[View, ...]:
        """The training views. Samplers use positions in this tuple as view indices."""
        return self.scene.train_views

    @cached_property
    def row_of(self) -> dict[str, int]:
        """Name of a training view -> its position in `train_views`."""
        return {view.name: row for row, view in enumerate(self.train_views)}

    @cached_property
    def per_photo(self) -> Mapping[str, PerPhoto]:
        """The exposure parameters with one value for each training photo."""
        return self.exposure.per_photo(self.scene)

    @cached_property
    def weighs(self) -> bool:
        """True if a plugin weights pixels of the loss."""
        return bool(self.hook.crossgrad_pixel_weights.get_hookimpls())

    @cached_property
    def watchers(self) -> tuple[str, ...]:
        """Names of the plugins that read the separate gradients of the views."""
        wants = "needs_separate_gradients"
        return tuple(name for name, plugin in self.plugins.items() if getattr(plugin, wants, False))

    @cached_property
    def separate(self) -> bool:
        """True if the gradients of the views are stored separately."""
        return self.operator.separate or bool(self.watchers)

    @cached_property
    def operator_scale(self) -> OperatorScale:
        """The scale of the operator's result for equal gradients of the views."""
        return OperatorScale(self.operator)

    @cached_property
    def joint(self) -> bool:
        """True if a single backward pass computes the gradient of the summed loss of all views."""
        return self.config.backward == "joint"

    @cached_property
    def sparse_rows(self) -> Mapping[str, str]:
        """Field of the Gaussians -> tensor.

        Adam steps of this tensor are deferred until a row is rendered.
        """
        trained = {name for block in self.trained_blocks for name in block.tensors}
        # A plugin that reads the model after each step needs all rows up to date. A wrapper of the
        # aggregation needs dense gradients.
        whole = self.joint or self.shows_model or self.device.type != "cpu"
        wrapped = len(self.hook.crossgrad_aggregate_gradients.get_hookimpls()) > 1
        if whole or wrapped or not (self.rasterizer.sparse_rows and self.operator.sparse_rows):
            return {}
        passthrough = self.backbone.passthrough
        return {field: name for field, name in passthrough.items() if name in trained}

    @cached_property
    def update_intervals(self) -> Mapping[str, int]:
        """Trained tensor -> N, for tensors that are updated in one of N steps.

        Raises:
            UserError: A plugin names a tensor that is not trained, or N is not a whole number of at
                least 1.
        """
        hook = self.hook.crossgrad_update_intervals
        trained = {name for block in self.trained_blocks for name in block.tensors}
        answers: list[Mapping[str, int]] = hook(blocks=self.trained_blocks)
        intervals = {name: every for answer in answers for name, every in answer.items()}
        if wrong := {
            n: e for n, e in intervals.items() if n not in trained or int(e) != e or e < 1
        }:
            raise wrong_answer(
                hook, "trained tensors, each with a number of at least 1", str(wrong)
            )
        return intervals

    def resting(self, step: int) -> frozenset[str]:
        """Return the names of the tensors that are not updated in a step."""
        intervals = self.update_intervals.items()
        return frozenset(name for name, every in intervals if not learns_in(step, every))

    @cached_property
    def regularizes(self) -> bool:
        """True if a plugin adds regularization terms to the loss."""
        return bool(self.hook.crossgrad_regularize.get_hookimpls())

    @cached_property
    def shows_model(self) -> bool:
        """True if a plugin reads the model after each step."""
        return bool(self.hook.crossgrad_model_ready.get_hookimpls())

    @cached_property
    def acts_after_step(self) -> bool:
        """True if a plugin implements the hook `crossgrad_after_step`."""
        return bool(self.hook.crossgrad_after_step.get_hookimpls())

    @cached_property
    def follows_steps(self) -> bool:
        """True if a plugin updates its state after each complete step."""
        return bool(self.hook.crossgrad_step_done.get_hookimpls())

    @cached_property
    def changes_rates(self) -> bool:
        """True if a plugin changes learning rates."""
        return bool(self.hook.crossgrad_rate_factor.get_hookimpls())

    @cached_property
    def gaussians_hooks(self) -> tuple[pluggy.HookCaller, ...]:
        """The hooks of plugins that change the Gaussians of training views.

        Each plugin has its own hook.
        """
        return one_by_one(self.manager, "crossgrad_view_gaussians")

    @cached_property
    def optimizer_hooks(self) -> tuple[pluggy.HookCaller, ...]:
        """The hooks of plugins that act after the optimizer. Each plugin has its own hook."""
        return one_by_one(self.manager, "crossgrad_after_optimizer")

    def phase(self, step: int, *, training: bool) -> Phase:
        """Return the phase of training or evaluation in which the backbone decodes."""
        return Phase(step, training, self.schedule)
