"""DC4GS: splits where the directions of a Gaussian's gradients disagree, and where they part."""

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, Rows, screen_statistics
from crossgrad_plugins.densifiers.clone_split import CloneSplit, Growth, Plan, child_on_axis

#: Candidate planes, across the longest axis at -2, -1, 0, 1, 2 standard deviations.
PLANES = 5


def inconsistency(sums: Tensor) -> Tensor:
    """[N] (1 - R) ga of pixels whose directions, absolute gradients and number are `sums`.

    R is the length of the mean direction, 1 where there is no pixel; ga is the norm of the absolute
    gradients. So nothing that pulls one way, or not at all, has any.

    Args:
        sums: [5, N] fields of `Screen.directions`, added up over bins.

    Source: DC4GS.
    """
    x, y, absolute_x, absolute_y, number = sums
    # No pixel: 1 - 0 / 1 times a ga of 0. Rounding can make the mean longer than unit vectors.
    rest = (1.0 - torch.sqrt(x * x + y * y) / number.clamp(min=1.0)).clamp(min=0.0)
    found: Tensor = rest * torch.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    return found


def plane_scores(bins: Tensor) -> Tensor:
    """[5, N] mean of the inconsistencies on both sides of each plane.

    Args:
        bins: [6, 5, N] from `screen_statistics.directions`.
    """
    left, right = [bins[0]], [bins[-1]]
    for plane in range(1, PLANES):
        left.append(left[-1] + bins[plane])
        # From the other end: the whole less the left would leave roundings where there is nothing.
        right.append(right[-1] + bins[-1 - plane])
    sides = zip(left, reversed(right), strict=True)
    return torch.stack([(inconsistency(a) + inconsistency(b)) / 2.0 for a, b in sides])


#: The candidate planes as shares of the axis, which is six standard deviations long.
NODES = np.arange(1, 6) / 6.0
#: Where the polynomial is evaluated besides.
GRID = np.linspace(1.0 / 12.0, 11.0 / 12.0, 1000)


def split_positions(scores: Tensor) -> Tensor:
    """[S] share p of the axis that the left child gets, in [1/12, 11/12].

    The polynomial of degree 4 through the scores is searched on a grid and at its nodes. Of equal
    values the most central one counts, so that no preference means the middle.

    Args:
        scores: [S, 5] of the planes at p = 1/6 .. 5/6, finite.

    Source: DC4GS.
    """
    places, weights = _interpolation()
    lowest = scores.double() - scores.double().amin(dim=1, keepdim=True)
    values = lowest @ torch.from_numpy(weights).to(lowest)
    return torch.from_numpy(places).to(scores)[values.argmin(dim=1)]


def _interpolation() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places [Q], the central ones first, and Lagrange's weights [5, Q] of the scores there."""
    places = np.concatenate([NODES, GRID])
    places = places[np.argsort(np.abs(places - 0.5), kind="stable")]
    weights = np.ones((len(NODES), len(places)))
    for i, node in enumerate(NODES):
        for other in np.delete(NODES, i):
            weights[i] *= (places - other) / (node - other)
    return places, weights


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
