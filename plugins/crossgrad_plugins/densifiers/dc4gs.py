"""DC4GS: splits Gaussians whose gradient directions disagree, at the best cut position."""

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, Rows, screen_statistics
from crossgrad_plugins.densifiers.clone_split import CloneSplit, Growth, Plan, child_on_axis

#: Number of candidate planes that cut the longest axis: at -2, -1, 0, 1, 2 standard deviations.
PLANES = 5


def inconsistency(sums: Tensor) -> Tensor:
    """Return [N] the inconsistency (1 - R) ga of the pixels of each Gaussian.

    R is the length of the mean gradient direction, or 0 if there is no pixel. ga is the norm of the
    sums of absolute gradients. The result is 0 if all gradients have one direction or if all are
    zero.

    Args:
        sums: [5, N] fields of `Screen.directions`, summed over bins: direction (x, y), absolute
            gradients (x, y), number of pixels.

    Source: DC4GS.
    """
    x, y, absolute_x, absolute_y, number = sums
    # For a Gaussian without pixels, the mean length is 0 / 1 and the gradient sum is 0, so the
    # result is 0. Rounding can make the length of the mean larger than 1.
    rest = (1.0 - torch.sqrt(x * x + y * y) / number.clamp(min=1.0)).clamp(min=0.0)
    scores: Tensor = rest * torch.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    return scores


def plane_scores(bins: Tensor) -> Tensor:
    """Return [5, N] the mean inconsistency of the two sides of each candidate plane.

    Args:
        bins: [6, 5, N] from `screen_statistics.directions`.
    """
    left, right = [bins[0]], [bins[-1]]
    for plane in range(1, PLANES):
        left.append(left[-1] + bins[plane])
        # Sum the bins of the right side separately. The total minus the left side would contain
        # rounding errors even if the right side is empty.
        right.append(right[-1] + bins[-1 - plane])
    sides = zip(left, reversed(right), strict=True)
    return torch.stack([(inconsistency(a) + inconsistency(b)) / 2.0 for a, b in sides])


#: Positions of the candidate planes, as shares of the longest axis, which is six standard
#: deviations long.
NODES = np.arange(1, 6) / 6.0
#: Further positions at which the interpolation polynomial is evaluated.
GRID = np.linspace(1.0 / 12.0, 11.0 / 12.0, 1000)


def split_positions(scores: Tensor) -> Tensor:
    """Return [S] the best cut position: the left child's share p of the axis, in [1/12, 11/12].

    A polynomial of degree 4 is fitted to the scores of the five planes. Its minimum is searched on
    a grid and at the five planes. If several positions have the minimum, the most central position
    is used.

    Args:
        scores: [S, 5] finite scores of the planes at p = 1/6 .. 5/6.

    Source: DC4GS.
    """
    places, weights = _interpolation()
    lowest = scores.double() - scores.double().amin(dim=1, keepdim=True)
    values = lowest @ torch.from_numpy(weights).to(lowest)
    return torch.from_numpy(places).to(scores)[values.argmin(dim=1)]


def _interpolation() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions [Q], central positions first, and their Lagrange weights [5, Q]."""
    places = np.concatenate([NODES, GRID])
    places = places[np.argsort(np.abs(places - 0.5), kind="stable")]
    weights = np.ones((len(NODES), len(places)))
    for i, node in enumerate(NODES):
        for other in np.delete(NODES, i):
            weights[i] *= (places - other) / (node - other)
    return places, weights


class DirectionalConsistency(CloneSplit):
    """Clones by the mean gradient; splits by (1 - R) ga, large if gradient directions disagree.

    R is the length of the mean direction of the pixels' gradients, and ga is the norm of the sums
    of their absolute values. R and ga are computed per view. The product (1 - R) ga is averaged
    over the renders in which the Gaussian was visible. The two children of a split are next to each
    other on the longest axis. The parent is cut at the position where the gradient directions agree
    best on each side.
    """

    needs = frozenset({"directions"})

    grad_threshold: float = Field(
        2e-4, gt=0, description="mean NDC gradient norm above which Gaussians are cloned"
    )
    split_threshold: float = Field(
        4e-4, gt=0, description="mean (1 - R) ga, NDC, above which Gaussians are split"
    )

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
        # Divide both criteria by their thresholds, so that clones and splits have comparable
        # priorities.
        urge = torch.where(small, gradient / self.grad_threshold, parting / self.split_threshold)
        return Growth(clone=clone, split=split, strength=urge)

    @override
    def grown_values(
        self, context: DensifyContext, state: PluginState, plan: Plan
    ) -> dict[str, Rows]:
        rows = plan.child.nonzero().squeeze(1)
        # The first children of all parents come before the second children.
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
    """Return new values for the left or right children of parents [S], cut at `position` [S].

    The longest axis is six standard deviations long. The left child gets the share p of the axis,
    and the share p of the opacity. The centre of the left child is 3 (1 - p) standard deviations
    left of the parent's centre.
    """
    share = 1.0 - position if right else position
    offset = 3.0 * (1.0 - share) * (1.0 if right else -1.0)
    return child_on_axis(context, parents, offset, torch.log(share), torch.log(share))
