"""Multi-view density control (FastGS, arXiv 2511.04283)."""

from collections.abc import Mapping
from dataclasses import replace
from math import ceil
from typing import cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import (
    NO_EDIT,
    DensifyContext,
    Edit,
    PluginState,
    Rows,
    Schedule,
    Selection,
    screen_statistics,
)
from crossgrad_plugins.densifiers.absgrad import gradient_sums
from crossgrad_plugins.densifiers.clone_split import AxisSplit, Growth, Plan, edited_parameters
from crossgrad_plugins.densifiers.error_pixel_counts import CountsMarkedPixels

#: Shortest interval between edits, in views (the published interval of the larger variant).
SHORTEST_INTERVAL = 100
#: Key of the number of late prunings that have been done.
LATE = "late"


class MultiViewDensityControl(CountsMarkedPixels, AxisSplit):
    """Clones, splits and prunes by the errors of several views, also after density control ends.

    A Gaussian may grow if it is blended in more than `importance` erroneous pixels per view on
    average. Clones are selected by the norm of the mean gradient, and splits by the norm of the
    absolute gradients. Only a random share of the usual pruning candidates is removed. The
    probability of a candidate increases with its share in the errors. After density control has
    ended, late prunings remove Gaussians that are faint or have nearly the largest error. For
    anchors, use the densifier `multiview-gate`.
    """

    needs = frozenset({"abs_gradient", "count"})

    split_scale: float = Field(
        0.001,
        gt=0,
        description="Gaussians with larger scales are split, others cloned; scene extents",
    )
    grad_threshold: float = Field(
        2e-4, gt=0, description="mean NDC gradient norm above which Gaussians are cloned"
    )
    abs_threshold: float = Field(
        1.2e-3, gt=0, description="mean absolute gradient above which Gaussians are split"
    )
    interval: float = Field(
        1 / 60,
        gt=0,
        lt=1,
        description="interval between edits as a share of the run, at least 100 views",
    )
    prune_share: float = Field(
        0.5, gt=0, le=1, description="share of the candidates that is pruned"
    )
    cap_opacity: float = Field(
        0.8, gt=0, le=1, description="upper limit of opacities after each edit; 1 for none"
    )
    late_prunings: tuple[float, ...] = Field(
        (0.6, 0.7, 0.8, 0.9),
        description="times of late prunings as shares of the run, after the end of density control",
    )
    late_opacity: float = Field(
        0.1, ge=0, lt=1, description="late prunings remove Gaussians below this opacity"
    )
    late_score: float = Field(
        0.9, gt=0, le=1, description="... and with more than this share in the error"
    )

    @override
    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        late = len(self.late_prunings) > 0
        why = "there are no late_prunings; leave the option out"
        unused = {} if late else {"late_opacity": why, "late_score": why}
        return {**super().unused_options(selection), **self.idle_counting(renders=late), **unused}

    @property
    @override
    def by_size(self) -> bool:
        return True

    @override
    def window(self, schedule: Schedule) -> Schedule:
        every = max(SHORTEST_INTERVAL, round(self.interval * schedule.length))
        return schedule.with_edits(until=schedule.length // 2, every=every)

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        counts = self.counted(context, state)
        gradients = gradient_sums(context, state)
        return PluginState(counts.values, per_primitive={**gradients, **counts.per_primitive})

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        seen = self.importance_of(state)
        asked = seen.above(self.importance)
        gradient = screen_statistics.mean(state.per_primitive, "gradient", "renders")
        absolute = screen_statistics.mean(state.per_primitive, "absolute", "renders")
        clone = small & (gradient >= self.grad_threshold) & asked.any(dim=1)
        split = ~small & (absolute >= self.abs_threshold) & asked.any(dim=1)
        strength = seen.strength(asked & (clone | split)[:, None])
        return Growth(clone=clone, split=split, strength=strength)

    @override
    def pruned(
        self, context: DensifyContext, state: PluginState, plan: Plan, values: Mapping[str, Rows]
    ) -> Tensor:
        candidates = super().pruned(context, state, plan, values)
        score = self.importance_of(state).pruning_score[plan.source]
        return some_of(candidates, score, self.prune_share, context.rng)

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.collects(context.step):
            return self._pruned_late(context, state)
        edit, state = super().densify(context, state)
        if context.schedule.densifies(context.step):
            edit = self._capped(context, edit)
        return edit, state

    def _capped(self, context: DensifyContext, edit: Edit) -> Edit:
        """Limit the opacities of an edit to the cap; lower opacities keep their Adam moments."""
        if self.cap_opacity == 1.0 or "opacities" in edit.values:
            return edit  # Opacities are limited to a lower cap if this edit also resets opacities.
        after = edited_parameters(context, edit)
        capped = context.backbone.capped_opacities(after, self.cap_opacity)
        rows = (capped < after["opacities"].detach()).nonzero().squeeze(1)
        if len(rows) == 0:
            return edit
        values = {**edit.values, "opacities": Rows(capped[rows], rows)}
        return replace(edit, values=values, counts={**edit.counts, "capped": len(rows)})

    def _pruned_late(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        """Remove faint primitives and primitives with nearly the largest error.

        Nothing is removed in steps without a late pruning.
        """
        schedule = context.schedule
        reached = schedule.counted(context.step) / schedule.length
        due = sum(share <= reached for share in self.late_prunings) if schedule.grows else 0
        done = cast("int", state.values.get(LATE, 0))
        state = PluginState({LATE: max(due, done)})
        if due <= done:
            return NO_EDIT, state
        score = self.importance_of(self.rendered(context)).pruning_score
        opacities = sigmoid(context.parameters["opacities"].detach())
        kept = (opacities >= self.late_opacity) & (score <= self.late_score)
        pruned = int((~kept).sum())
        if pruned == 0:
            return NO_EDIT, state
        return Edit(kept.nonzero().squeeze(1), counts={"pruned": pruned}), state


def some_of(candidates: Tensor, score: Tensor, share: float, rng: np.random.Generator) -> Tensor:
    """Return [M], True for a random share of the candidates [M], drawn without replacement.

    Candidates are drawn one by one with probabilities proportional to 1 / (1 - score). The
    implementation sorts exponential random numbers times 1 - score, which gives the same
    distribution (Efraimidis and Spirakis 2006).
    """
    rows = candidates.nonzero().squeeze(1)
    weight = 1.0 - score[rows].double().cpu().numpy()
    order = np.argsort(rng.exponential(size=len(rows)) * weight, kind="stable")
    drawn = torch.zeros_like(candidates)
    drawn[rows[torch.from_numpy(order[: ceil(share * len(rows))]).to(rows.device)]] = True
    return drawn
