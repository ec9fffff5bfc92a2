"""Adaptive density control of 3DGS: clone, split, prune, opacity reset (Kerbl et al. 2023, 5.2)."""

from dataclasses import dataclass, replace
from math import log

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contexts import DensifyContext, ViewRecord
from crossgrad_core.densifier import Densifier
from crossgrad_core.splats import rotation_matrices
from crossgrad_core.state import PluginState
from crossgrad_core.topology import NO_EDIT, Edit, NoEdit, Rows

#: A split divides the scales by this (3DGS).
SPLIT_SHRINK = 1.6


@dataclass(frozen=True)
class _Plan:
    """Which primitives survive, in the order of the new set.

    Attributes:
        source: [M] int64 old index of each new primitive.
        fresh: [M] bool, clones and children.
        child: [M] bool, children of a split.
    """

    source: Tensor
    fresh: Tensor
    child: Tensor

    def kept(self, keep: Tensor) -> "_Plan":
        return _Plan(self.source[keep], self.fresh[keep], self.child[keep])


class AdaptiveDensityControl(Densifier):
    """Clones small and splits large Gaussians whose projected mean moves; prunes faint ones.

    The statistic of a Gaussian is the mean over the renders in which it was visible of the norm of
    the loss gradient by its projected mean in NDC units (pixel gradient times W/2, H/2), taken per
    view from that view's own loss. The published rule by screen radius never fires in the original
    code and is left out.
    """

    blocks = frozenset({"means", "scales", "quats", "opacities"})

    grad_threshold: float = Field(2e-4, gt=0, description="mean NDC gradient norm to densify at")
    split_scale: float = Field(0.01, gt=0, description="split above, clone below; scene extents")
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="prune below")
    prune_scale: float = Field(0.1, gt=0, description="prune above, scene extents")
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="cap of an opacity reset")

    @override
    def densify(
        self, context: DensifyContext, state: PluginState
    ) -> tuple[Edit | NoEdit, PluginState]:
        if not context.schedule.collects(context.step):
            return NO_EDIT, PluginState()
        state = _observed(context, state)
        if context.schedule.densifies(context.step):
            edit = self._edit(context, state)
            return edit, _zeroed(state)
        if context.schedule.resets(context.step):
            return self._with_reset(context, Edit()), state
        return NO_EDIT, state

    def _edit(self, context: DensifyContext, state: PluginState) -> Edit | NoEdit:
        grow, held_back = self._grown(context, state)
        largest = torch.exp(context.parameters["scales"].detach()).amax(dim=1)
        split = grow & (largest > self.split_scale)
        clone = grow & ~split
        plan = _planned(clone, split)
        plan = plan.kept(~self._pruned(context, plan, largest))
        edit = self._as_edit(context, plan, clone, split)
        if held_back > 0:
            edit = replace(edit, counts={**edit.counts, "held_back": held_back})
        if context.schedule.resets(context.step):
            return self._with_reset(context, edit)
        return edit

    def _grown(self, context: DensifyContext, state: PluginState) -> tuple[Tensor, int]:
        """[N] bool, Gaussians to clone or split, and how many more there was no room for."""
        sums, counts = state.per_primitive["gradient"], state.per_primitive["renders"]
        mean = torch.where(counts > 0, sums / counts.clamp(min=1.0), torch.zeros_like(sums))
        grow = mean >= self.grad_threshold
        held_back = max(0, int(grow.sum()) - context.room)
        if held_back > 0:
            strongest = torch.argsort(mean, descending=True, stable=True)[: context.room]
            grow = torch.zeros_like(grow)
            grow[strongest] = True
        return grow, held_back

    def _pruned(self, context: DensifyContext, plan: _Plan, largest: Tensor) -> Tensor:
        opacities = torch.sigmoid(context.parameters["opacities"].detach())[plan.source]
        pruned = opacities < self.prune_opacity
        if context.step > context.schedule.prune_large_from:
            scales = largest[plan.source]
            scales = torch.where(plan.child, scales / SPLIT_SHRINK, scales)
            pruned |= scales > self.prune_scale
        return pruned

    def _as_edit(self, context: DensifyContext, plan: _Plan, clone: Tensor, split: Tensor) -> Edit:
        unchanged = plan.source.shape[0] == clone.shape[0] and not bool(plan.fresh.any())
        if unchanged:
            return Edit()
        rows = plan.child.nonzero().squeeze(1)
        parents = plan.source[rows]
        values = {}
        if rows.numel() > 0:
            means, scales = _children(context, parents)
            values = {"means": Rows(means, rows), "scales": Rows(scales, rows)}
        before = clone.shape[0] + int(clone.sum()) + int(split.sum())
        counts = {
            "cloned": int(clone.sum()),
            "split": int(split.sum()),
            "pruned": before - int(plan.source.shape[0]),
        }
        return Edit(plan.source, plan.fresh, values, counts)

    def _with_reset(self, context: DensifyContext, edit: Edit) -> Edit:
        opacities = context.parameters["opacities"].detach()
        if edit.source is not None:
            opacities = opacities[edit.source]
        capped = opacities.clamp(max=log(self.reset_opacity / (1.0 - self.reset_opacity)))
        values = {**edit.values, "opacities": Rows(capped)}
        return Edit(edit.source, edit.fresh, values, {**edit.counts, "reset": capped.shape[0]})


def _planned(clone: Tensor, split: Tensor) -> _Plan:
    stay = (~split).nonzero().squeeze(1)
    clones = clone.nonzero().squeeze(1)
    parents = split.nonzero().squeeze(1)
    source = torch.cat([stay, clones, parents, parents])
    fresh = torch.zeros(source.shape[0], dtype=torch.bool, device=source.device)
    fresh[stay.shape[0] :] = True
    child = torch.zeros_like(fresh)
    child[stay.shape[0] + clones.shape[0] :] = True
    return _Plan(source, fresh, child)


def _children(context: DensifyContext, parents: Tensor) -> tuple[Tensor, Tensor]:
    """Means [R, 3] drawn from the parents' Gaussians and their shrunk log scales [R, 3]."""
    parameters = context.parameters
    log_scales = parameters["scales"].detach()[parents]
    draws = context.rng.standard_normal((parents.shape[0], 3)).astype(np.float32)
    noise = torch.from_numpy(draws).to(log_scales)
    rotations = rotation_matrices(parameters["quats"].detach()[parents])
    offsets = (rotations @ (torch.exp(log_scales) * noise)[:, :, None]).squeeze(-1)
    return parameters["means"].detach()[parents] + offsets, log_scales - log(SPLIT_SHRINK)


def _observed(context: DensifyContext, state: PluginState) -> PluginState:
    """The statistics with the views of this step added, view by view in order."""
    means = context.parameters["means"]
    zeros = torch.zeros(means.shape[0], device=means.device)
    sums = state.per_primitive.get("gradient", zeros).clone()
    counts = state.per_primitive.get("renders", zeros).clone()
    for record in context.views:
        _observe(record, sums, counts)
    return PluginState(per_primitive={"gradient": sums, "renders": counts})


def _observe(record: ViewRecord, sums: Tensor, counts: Tensor) -> None:
    gradient = record.screen.mean_gradient
    if gradient is None:
        raise RuntimeError("densification statistics were read before the backward pass")
    camera = record.view.camera
    half = torch.tensor([camera.width / 2, camera.height / 2]).to(gradient)
    norms = torch.linalg.vector_norm(gradient * half, dim=1)
    visible = (record.screen.radii > 0).to(norms)
    origin = record.gaussians.origin
    if origin is None:
        sums += norms * visible
        counts += visible
    else:
        sums.index_add_(0, origin, norms * visible)
        counts.index_add_(0, origin, visible)


def _zeroed(state: PluginState) -> PluginState:
    zeros = {name: torch.zeros_like(old) for name, old in state.per_primitive.items()}
    return PluginState(per_primitive=zeros)
