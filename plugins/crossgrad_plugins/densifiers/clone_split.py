"""Edits of the 3DGS family: clone, split, split along the longest axis, prune, opacity reset."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import log, sqrt
from typing import Final, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.elementwise import logsigmoid, sigmoid
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.plugin import (
    NO_EDIT,
    Densifier,
    DensifyContext,
    Edit,
    Parameters,
    Phase,
    PluginState,
    Rows,
    Selection,
    apply_to_parameters,
)

#: A split divides the scales of the parent by this factor (3DGS).
SPLIT_SHRINK = 1.6
#: Length of a child along the parent's longest axis, relative to the parent's length. The
#: children's centres are at the distance `_APART` on both sides of the parent's centre. Together,
#: the two children then have the variance of the parent. The opacity of each child is the parent's
#: opacity times `_FAINTER`, so that both children together cover as much as the parent.
_KEPT: Final = 0.6
_APART: Final = sqrt(1.0 - _KEPT**2)
_FAINTER: Final = 1.0 / (2.0 * _KEPT)


@dataclass(frozen=True)
class Growth:
    """The primitives that an edit clones or splits.

    Attributes:
        clone: [P] bool, primitives that are duplicated in place.
        split: [P] bool, primitives that are replaced by two smaller primitives; a primitive is not
            both split and cloned.
        strength: [P] priority of each primitive; if the budget is short, the strongest primitives
            grow first.
    """

    clone: Tensor
    split: Tensor
    strength: Tensor

    def among(self, may_grow: Tensor | None) -> "Growth":
        """Return the growth, limited to primitives that may grow [P]; None means all primitives."""
        if may_grow is None:
            return self
        return replace(self, clone=self.clone & may_grow, split=self.split & may_grow)

    def limited(self, room: int) -> tuple["Growth", int]:
        """Return the growth of the `room` strongest primitives, and the number of omitted ones."""
        wanted = self.clone | self.split
        left_out = max(0, int(wanted.sum()) - room)
        if left_out == 0:
            return self, 0
        ranked = torch.where(wanted, self.strength, torch.full_like(self.strength, -torch.inf))
        chosen = torch.zeros_like(wanted)
        chosen[torch.argsort(ranked, descending=True, stable=True)[:room]] = True
        return replace(self, clone=self.clone & chosen, split=self.split & chosen), left_out


@dataclass(frozen=True)
class Plan:
    """The primitives between growth and pruning: survivors, clones, then both children.

    Attributes:
        source: [M] int64 old index of each new primitive.
        fresh: [M] bool, True for clones and children of a split.
        child: [M] bool, True for children of a split.
    """

    source: Tensor
    fresh: Tensor
    child: Tensor

    @classmethod
    def of(cls, growth: Growth) -> "Plan":
        """Return the plan of a growth."""
        stay = (~growth.split).nonzero().squeeze(1)
        clones = growth.clone.nonzero().squeeze(1)
        parents = growth.split.nonzero().squeeze(1)
        source = torch.cat([stay, clones, parents, parents])
        row_numbers = torch.arange(source.shape[0], device=source.device)
        return cls(source, row_numbers >= len(stay), row_numbers >= len(stay) + len(clones))


class CloneSplit(Densifier):
    """A densifier that grows by a screen statistic, and prunes faint and huge Gaussians.

    A subclass defines the statistics and the primitives that grow; all other steps follow 3DGS.
    3DGS also describes pruning by screen radius, which has no effect in the published code; it is
    left out.
    """

    tensors = frozenset({"means", "scales", "quats", "opacities"})
    reset_options = frozenset({"prune_scale", "reset_opacity"})
    budgeted = True

    split_scale: float = Field(
        0.01,
        gt=0,
        description="Gaussians with larger scales are split, others cloned; scene extents",
    )
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="prune below")
    prune_scale: float = Field(
        0.1, gt=0, description="Gaussians with larger scales are pruned; scene extents"
    )
    reset_opacity: float = Field(
        0.01, gt=0, lt=1, description="upper limit of opacities in an opacity reset"
    )

    @abstractmethod
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        """Return the statistics after the views of this step were added, in order of the views."""

    @abstractmethod
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        """Return the primitives that grow.

        Args:
            context: The context of the step.
            state: The state with the statistics.
            small: [P] bool, True for primitives that are small and therefore cloned.
        """

    def divided(self, context: DensifyContext, growth: Growth) -> Growth:
        """Return the growth with other choices between clone and split.

        By default, the growth is unchanged.
        """
        return growth

    def grown_values(
        self, context: DensifyContext, state: PluginState, plan: Plan
    ) -> dict[str, Rows]:
        """Return new values for rows of the plan.

        By default, these are means and scales of the children.

        Source: 3DGS, which draws the means from the parent's Gaussian and divides the scales by
        1.6.
        """
        rows = plan.child.nonzero().squeeze(1)
        parents = plan.source[rows]
        log_scales = context.parameters["scales"].detach()[parents]
        offsets = drawn_offsets(context, parents)
        return {
            "means": Rows(context.parameters["means"].detach()[parents] + offsets, rows),
            "scales": Rows(log_scales - log(SPLIT_SHRINK), rows),
        }

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.collects(context.step):
            return NO_EDIT, PluginState()
        state = self.observed(context, state)
        if context.schedule.densifies(context.step):
            edit = self._edit(context, state)
            return edit, _zeroed(state)
        if context.schedule.resets(context.step):
            return self._with_reset(context, Edit()), state
        return NO_EDIT, state

    def _edit(self, context: DensifyContext, state: PluginState) -> Edit:
        largest = torch.exp(context.parameters["scales"].detach()).amax(dim=1)
        small = largest <= self.split_scale
        growth = self.growth(context, state, small).among(context.may_grow)
        growth, held_back = self.divided(context, growth).limited(context.room)
        plan = Plan.of(growth)
        values = self.grown_values(context, state, plan) if bool(plan.fresh.any()) else {}
        keep = ~self.pruned(context, state, plan, values)
        counts = {
            "cloned": int(growth.clone.sum()),
            "split": int(growth.split.sum()),
            "pruned": int((~keep).sum()),
        }
        edit = Edit()
        if any(counts.values()):
            edit = Edit(plan.source[keep], plan.fresh[keep], _compacted(values, keep), counts)
        if held_back > 0:
            edit = replace(edit, counts={**edit.counts, "held_back": held_back})
        resets = context.schedule.resets(context.step)
        return self._with_reset(context, edit) if resets else edit

    def pruned(
        self, context: DensifyContext, state: PluginState, plan: Plan, values: Mapping[str, Rows]
    ) -> Tensor:
        """Return [M], True for primitives of the plan to remove.

        By default, these are faint and large primitives.
        """
        opacities = sigmoid(_planned(context, plan, values, "opacities"))
        pruned = opacities < self.prune_opacity
        if context.schedule.prunes_large(context.step):
            scales = torch.exp(_planned(context, plan, values, "scales"))
            pruned |= scales.amax(dim=1) > self.prune_scale
        return pruned

    def _with_reset(self, context: DensifyContext, edit: Edit) -> Edit:
        after = edited_parameters(context, edit)
        capped = context.backbone.capped_opacities(after, self.reset_opacity)
        values = {**edit.values, "opacities": Rows(capped)}
        return replace(edit, values=values, counts={**edit.counts, "reset": capped.shape[0]})


def edited_parameters(context: DensifyContext, edit: Edit) -> Parameters:
    """Return the parameters after an edit, including tensors that depend on other parameters."""
    after = apply_to_parameters(edit, context.backbone.blocks(), context.parameters)
    if edit.source is None:
        return after
    phase = Phase(context.step, training=True, schedule=context.schedule)
    return context.backbone.prepare(after, context.scene, phase)


def drawn_offsets(context: DensifyContext, parents: Tensor) -> Tensor:
    """Return [R, 3] a random sample of each parent's Gaussian, relative to its mean."""
    log_scales = context.parameters["scales"].detach()[parents]
    draws = context.rng.standard_normal((parents.shape[0], 3)).astype(np.float32)
    noise = torch.from_numpy(draws).to(log_scales)
    rotations = rotation_matrices(context.parameters["quats"].detach()[parents])
    return (rotations @ (torch.exp(log_scales) * noise)[:, :, None]).squeeze(-1)


def _planned(context: DensifyContext, plan: Plan, values: Mapping[str, Rows], name: str) -> Tensor:
    """Return a parameter for the primitives of the plan, with the new values inserted."""
    tensor = context.parameters[name].detach()[plan.source]
    if name in values:
        tensor[values[name].rows] = values[name].values
    return tensor


def _compacted(values: Mapping[str, Rows], keep: Tensor) -> dict[str, Rows]:
    """Return the values of the rows to keep [M], and their row numbers after pruning."""
    new_rows = torch.cumsum(keep, 0) - 1
    compacted = {}
    for name, old in values.items():
        rows = torch.arange(len(keep), device=keep.device) if old.rows is None else old.rows
        kept = keep[rows]
        compacted[name] = replace(old, values=old.values[kept], rows=new_rows[rows[kept]])
    return compacted


def _zeroed(state: PluginState) -> PluginState:
    zeros = {name: torch.zeros_like(old) for name, old in state.per_primitive.items()}
    return PluginState(per_primitive=zeros)


class AxisSplit(CloneSplit):
    """Clones and splits as in 3DGS, or splits each growing Gaussian along its longest axis.

    A clone has the same position and the same gradients as its parent. Parent and clone therefore
    move together until noise separates them, and together they are more opaque than the parent was.
    Children of a 3DGS split have random positions, which leave holes in the image. Two children on
    the longest axis look like the parent, and they differ from the first step on.
    """

    division: Literal["drawn", "axis"] = Field(
        "drawn",
        description="replacement of a growing Gaussian: drawn clones a small one and splits a "
        "large one into two random samples, as published; axis replaces it by two on "
        "its longest axis",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        if self.division != "axis" or self.by_size:
            return {}
        return {"split_scale": "with division axis the size has no effect; leave the option out"}

    @property
    def by_size(self) -> bool:
        """True if `split_scale` also selects the statistic that determines growth."""
        return False

    @override
    def divided(self, context: DensifyContext, growth: Growth) -> Growth:
        if self.division != "axis":
            return growth
        grown = growth.clone | growth.split
        return replace(growth, clone=torch.zeros_like(grown), split=grown)

    @override
    def grown_values(
        self, context: DensifyContext, state: PluginState, plan: Plan
    ) -> dict[str, Rows]:
        if self.division != "axis":
            return super().grown_values(context, state, plan)
        rows = plan.child.nonzero().squeeze(1)
        # The first children of all parents come before the second children.
        parents = plan.source[rows[: len(rows) // 2]]
        left, right = (
            child_on_axis(context, parents, offset, log(_KEPT), log(_FAINTER))
            for offset in (-_APART, _APART)
        )
        return {name: Rows(torch.cat([left[name], right[name]]), rows) for name in left}


def child_on_axis(
    context: DensifyContext,
    parents: Tensor,
    place: Tensor | float,
    length: Tensor | float,
    opacity: Tensor | float,
) -> dict[str, Tensor]:
    """Return new values for one child of each parent [S], on the parent's longest axis.

    Args:
        context: The context of the step.
        parents: Indices of the parents.
        place: [S] offset of the child's centre from the parent's centre along the axis, in standard
            deviations.
        length: [S] logarithm of the child's length divided by the parent's length, both along the
            axis.
        opacity: [S] logarithm of the child's opacity divided by the parent's opacity.

    Source: Deng et al. 2024 (arXiv 2411.10133), fixed positions on the longest axis.
    """
    edited = ("means", "scales", "quats", "opacities")
    old = {name: context.parameters[name].detach()[parents] for name in edited}
    longest = old["scales"].argmax(dim=1)
    every_parent = torch.arange(len(parents), device=parents.device)
    axis = rotation_matrices(old["quats"])[every_parent, :, longest]
    width = torch.exp(old["scales"][every_parent, longest])
    scales = old["scales"].clone()
    scales[every_parent, longest] += length
    logarithm = logsigmoid(old["opacities"]) + opacity
    return {
        "means": old["means"] + axis * (place * width)[:, None],
        "scales": scales,
        "opacities": logarithm - torch.log(-torch.expm1(logarithm)),
    }
