"""The parts of a run once its configuration is resolved; training changes nothing here."""

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
    """Return True if a tensor that learns in one of `every` steps learns in this one.

    The step is drawn by lot from each `every` steps: where samplers go through photos or regimes
    by turns, none of them is left out.
    """
    turn, place = divmod(step - 1, every)
    return place == hash32(turn) * every >> 32


@dataclass(frozen=True)
class Scale:
    """The scale of an operator's answer at one K, by tensor name.

    Attributes:
        per_step: c(K), what it makes of K equal gradients: K for their sum, 1 for their mean.
        per_view: c(K) / K.
        to_sum: K / |c(K)|, what brings the answer to the scale of the views' sum. Adam sees that
            one, as its eps and the limits of its arithmetic are absolute.
    """

    per_step: Mapping[str, float]
    per_view: Mapping[str, float]
    to_sum: Mapping[str, float]

    @classmethod
    def of(cls, sums: Mapping[str, float], views: int) -> "Scale":
        """The scale of an operator with these c(K) at K = `views`."""
        shares = {name: value / views for name, value in sums.items()}
        # An operator that answers equal gradients with zero has no scale to follow.
        to_sum = {name: 1.0 / (abs(share) or 1.0) for name, share in shares.items()}
        return cls(sums, shares, to_sum)


class OperatorScale:
    """c(K), the sum of an operator's weights for K equal gradients in a neutral context.

    The operator is asked once for each K and its labels, with K equal gradients of one element per
    tensor, without memory and with nothing that tells the views apart but their labels. So every
    operator has a scale: chains, one operator per block, those that work on elements, and a third
    party's.

    Args:
        operator: The operator.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._known: dict[tuple[int, tuple[str, ...] | None], Scale] = {}

    def of(self, context: AggregateContext) -> Scale:
        """The scale for the K and the labels of this step.

        Raises:
            UserError: The operator's answer to equal gradients is not finite.
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
            f"operator {type(self._operator).__name__} gives {views} equal gradients a weight that "
            "is not finite",
            where=f"block of {name}",
            expected="finite weights for finite gradients",
            todo="use another operator, or report this to the operator's author",
        )


def neutral(context: AggregateContext) -> AggregateContext:
    """The first step of K views, all at full size and alike in gradients, losses and distances."""
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
    """The resolved run.

    Attributes:
        config: The configuration with every decision filled in.
        scene: The scene.
        selection: The chosen components.
        manager: This run's plugin manager.
        plugins: Every registered plugin by name.
        groups: Label of each training view, or None.
        schedule: The schedule.
        device: Where tensors live.
        notes: What was chosen or left out, and why.
        scaled_photos: Where photos of smaller sizes, and those on a GPU, are kept.
        photos_ahead: The threads that decode photos beside the steps.
        decisions: The table of decided settings.
        decide: Makes the table for another length; a run that repeats another one decides nothing.
        revised: The settings that the clock has changed with the length of the run.
        pixel_share: Share of the time of a full-size step that goes with its pixels, as probed.
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
        """The configuration with the settings that the clock has changed."""
        return self.config.model_copy(update=dict(self.revised))

    @cached_property
    def numbers(self) -> Numbers:
        """The decided settings."""
        return Numbers.of(self.in_force)

    def following(self, steps: int, start: int | None) -> dict[str, Any]:
        """The settings that follow the length of the run, if it has so many steps in all.

        Args:
            steps: Steps of the run.
            start: Primitives at the start; None before they are counted.
        """
        rows = self.decide(Length(self.config.steps or steps, steps, start))
        return {row.setting: row.value for row in rows if row.setting in FOLLOWING}

    def at_length(self, steps: int, start: int | None) -> "Setup":
        """The run with the settings that it has in another length."""
        return replace(self, revised={**self.revised, **self.following(steps, start)})

    def with_rules(self, rules: Mapping[str, Rule]) -> "Setup":
        """The run with these rules in place of its own."""
        if rules == self.selection.rules:
            return self
        others = {n: each for n, each in self.plugins.items() if not isinstance(each, Rule)}
        selection = replace(self.selection, rules=rules)
        plugins = {**selection.plugins, **others}
        return replace(self, selection=selection, manager=make_manager(plugins), plugins=plugins)

    @property
    def backbone(self) -> Backbone:
        """The backbone."""
        return self.selection.backbone

    @property
    def sampler(self) -> Sampler:
        """The sampler."""
        return self.selection.sampler

    @property
    def operator(self) -> Operator:
        """The operator."""
        return self.selection.operator

    @property
    def densifier(self) -> Densifier:
        """The densifier."""
        return self.selection.densifier

    @property
    def rasterizer(self) -> Rasterizer:
        """The rasterizer."""
        return self.selection.rasterizer

    @property
    def loss(self) -> Loss:
        """The photometric loss."""
        return self.selection.loss

    @property
    def exposure(self) -> Exposure:
        """What cameras do to light."""
        return self.selection.exposure

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """What is measured of held-out views."""
        return tuple(self.selection.metrics.values())

    @cached_property
    def hook(self) -> pluggy.HookRelay:
        """The hook caller of this run."""
        return self.manager.hook

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The backbone's blocks."""
        return self.backbone.blocks()

    @cached_property
    def trained_blocks(self) -> tuple[Block, ...]:
        """The blocks that get gradients."""
        return self.backbone.trained_blocks()

    @cached_property
    def train_views(self) -> tuple[View, ...]:
        """The training views, in the order that samplers index."""
        return self.scene.train_views

    @cached_property
    def row_of(self) -> dict[str, int]:
        """Name of a training view -> its position."""
        return {view.name: row for row, view in enumerate(self.train_views)}

    @cached_property
    def per_photo(self) -> Mapping[str, PerPhoto]:
        """The parameters that every training photo has a value of."""
        return self.exposure.per_photo(self.scene)

    @cached_property
    def weighs(self) -> bool:
        """Whether any plugin weighs pixels."""
        return bool(self.hook.crossgrad_pixel_weights.get_hookimpls())

    @cached_property
    def watchers(self) -> tuple[str, ...]:
        """Names of the plugins that look at the gradients of single views."""
        wants = "needs_separate_gradients"
        return tuple(name for name, plugin in self.plugins.items() if getattr(plugin, wants, False))

    @cached_property
    def separate(self) -> bool:
        """Whether the views' gradients are kept apart."""
        return self.operator.separate or bool(self.watchers)

    @cached_property
    def operator_scale(self) -> OperatorScale:
        """What the operator makes of equal gradients."""
        return OperatorScale(self.operator)

    @cached_property
    def joint(self) -> bool:
        """Whether one backward pass runs through the sum of the views' losses."""
        return self.config.backward == "joint"

    @cached_property
    def sparse_rows(self) -> Mapping[str, str]:
        """Field of the Gaussians -> tensor whose steps wait until a row is drawn."""
        trained = {name for block in self.trained_blocks for name in block.tensors}
        # Who looks at the model after each step reads every row, and a wrapper of the aggregation
        # computes with dense gradients.
        whole = self.joint or self.shows_model or self.device.type != "cpu"
        wrapped = len(self.hook.crossgrad_aggregate_gradients.get_hookimpls()) > 1
        if whole or wrapped or not (self.rasterizer.sparse_rows and self.operator.sparse_rows):
            return {}
        passthrough = self.backbone.passthrough
        return {field: name for field, name in passthrough.items() if name in trained}

    @cached_property
    def update_intervals(self) -> Mapping[str, int]:
        """Trained tensor -> N, of those that learn in one of N steps.

        Raises:
            UserError: A plugin names another tensor, or no number from 1 on.
        """
        hook = self.hook.crossgrad_update_intervals
        trained = {name for block in self.trained_blocks for name in block.tensors}
        answers: list[Mapping[str, int]] = hook(blocks=self.trained_blocks)
        found = {name: every for answer in answers for name, every in answer.items()}
        if wrong := {n: e for n, e in found.items() if n not in trained or int(e) != e or e < 1}:
            raise wrong_answer(hook, "tensors that learn, each with a number from 1 on", str(wrong))
        return found

    def resting(self, step: int) -> frozenset[str]:
        """The tensors that do not learn in a step."""
        intervals = self.update_intervals.items()
        return frozenset(name for name, every in intervals if not learns_in(step, every))

    @cached_property
    def regularizes(self) -> bool:
        """Whether any plugin adds loss terms."""
        return bool(self.hook.crossgrad_regularize.get_hookimpls())

    @cached_property
    def shows_model(self) -> bool:
        """Whether any plugin looks at the model after a step."""
        return bool(self.hook.crossgrad_model_ready.get_hookimpls())

    @cached_property
    def acts_after_step(self) -> bool:
        """Whether any plugin acts after the step."""
        return bool(self.hook.crossgrad_after_step.get_hookimpls())

    @cached_property
    def follows_steps(self) -> bool:
        """Whether any plugin follows the parameters from step to step."""
        return bool(self.hook.crossgrad_step_done.get_hookimpls())

    @cached_property
    def changes_rates(self) -> bool:
        """Whether any plugin changes learning rates."""
        return bool(self.hook.crossgrad_rate_factor.get_hookimpls())

    @cached_property
    def gaussians_hooks(self) -> tuple[pluggy.HookCaller, ...]:
        """The plugins that change the Gaussians of training views, each by itself."""
        return one_by_one(self.manager, "crossgrad_view_gaussians")

    @cached_property
    def optimizer_hooks(self) -> tuple[pluggy.HookCaller, ...]:
        """The plugins that act after the optimizer, each by itself."""
        return one_by_one(self.manager, "crossgrad_after_optimizer")

    def phase(self, step: int, *, training: bool) -> Phase:
        """The phase that a backbone decodes in."""
        return Phase(step, training, self.schedule)
