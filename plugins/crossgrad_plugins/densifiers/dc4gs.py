"""DC4GS: splits where the directions of a Gaussian's gradients disagree, and where they part."""

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, Rows, screen_statistics
from crossgrad_plugins.densifiers.clone_split import CloneSplit, Growth, Plan
from crossgrad_plugins.densifiers.direction_scores import (
    PLANES,
    inconsistency,
    plane_scores,
)
from crossgrad_plugins.densifiers.long_axis_split import child_on_axis
from crossgrad_plugins.densifiers.split_position import split_positions


class DirectionalConsistency(CloneSplit):
    """Clones by the mean gradient, splits by (1 - R) ga where the directions part.

    R is the length of the mean direction of the pixels' gradients and ga the norm of their absolute
    values, per view; (1 - R) ga is averaged over the renders in which the Gaussian was visible.
    The children of a split lie side by side on the longest axis, cut where both sides are most
    consistent.
    """

    needs = frozenset({"directions"})

    grad_threshold: float = Field(2e-4, gt=0, description="mean NDC gradient norm to clone at")
    split_threshold: float = Field(4e-4, gt=0, description="mean (1 - R) ga, NDC, to split at")

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        totals = screen_statistics.sums(context, state, ("gradient", "inconsistency", "renders"))
        zeros = totals["renders"].new_zeros(totals["renders"].shape[0], PLANES)
        totals["planes"] = state.per_primitive.get("planes", zeros).clone()
        for record in context.views:
            seen = screen_statistics.visible(record)
            bins = screen_statistics.directions(record)
            norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record), dim=1)
            screen_statistics.add(record, totals["gradient"], norms * seen)
            screen_statistics.add(record, totals["inconsistency"], inconsistency(bins.sum(dim=0)))
            screen_statistics.add(record, totals["planes"], plane_scores(bins).T)
            screen_statistics.add(record, totals["renders"], seen)
        return PluginState(per_primitive=totals)

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        gradient = screen_statistics.mean(state.per_primitive, "gradient", "renders")
        parting = screen_statistics.mean(state.per_primitive, "inconsistency", "renders")
        clone = (gradient >= self.grad_threshold) & small
        split = (parting >= self.split_threshold) & ~small
        # In units of the thresholds clones and splits compare where room is short.
        urge = torch.where(small, gradient / self.grad_threshold, parting / self.split_threshold)
        return Growth(clone=clone, split=split, strength=urge)

    @override
    def grown_values(
        self, context: DensifyContext, state: PluginState, plan: Plan
    ) -> dict[str, Rows]:
        rows = plan.child.nonzero().squeeze(1)
        # The first children of all parents come before the second ones.
        parents = plan.source[rows[: len(rows) // 2]]
        position = split_positions(state.per_primitive["planes"][parents])
        children = [
            _child(context, parents, position, right=False),
            _child(context, parents, position, right=True),
        ]
        return {
            name: Rows(torch.cat([child[name] for child in children]), rows)
            for name in ("means", "scales", "opacities")
        }


def _child(
    context: DensifyContext, parents: Tensor, position: Tensor, *, right: bool
) -> dict[str, Tensor]:
    """New values of the left or right children of some parents [S], cut at `position` [S].

    The longest axis is six standard deviations long. The left child has the first share p of it,
    and that share of the opacity: its middle is 3 (1 - p) deviations left of the parent's.
    """
    share = 1.0 - position if right else position
    place = 3.0 * (1.0 - share) * (1.0 if right else -1.0)
    return child_on_axis(context, parents, place, torch.log(share), torch.log(share))
