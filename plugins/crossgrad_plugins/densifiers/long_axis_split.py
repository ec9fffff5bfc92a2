"""Growth along the longest axis: whatever grows becomes two Gaussians, side by side on it."""

from collections.abc import Mapping
from dataclasses import replace
from math import log, sqrt
from typing import Final, Literal

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.elementwise import logsigmoid
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.plugin import DensifyContext, PluginState, Rows, Selection
from crossgrad_plugins.densifiers.clone_split import CloneSplit, Growth, Plan

#: Length of a child on the axis, in parents. Two of these, so far to either side that they have the
#: variance of the parent together, and so much fainter that they cover as much.
_KEPT: Final = 0.6
_APART: Final = sqrt(1.0 - _KEPT**2)
_FAINTER: Final = 1.0 / (2.0 * _KEPT)


class AxisSplit(CloneSplit):
    """Clones and splits as 3DGS does, or splits all that grows, side by side on its longest axis.

    A clone lies where its parent does and has its gradients: both move as one until noise parts
    them, and are more opaque together than the parent was. Children drawn at random leave holes.
    Those side by side show what the parent showed, and differ from the first step on.
    """

    division: Literal["drawn", "axis"] = Field(
        "drawn",
        description="what grows becomes: drawn, a clone if it is small, else two drawn from it, as "
        "published; axis, two side by side on its longest axis",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        if self.division != "axis" or self.by_size:
            return {}
        return {"split_scale": "with division axis nothing depends on the size; leave it out"}

    @property
    def by_size(self) -> bool:
        """Whether `split_scale` says more than what is cloned: by which statistic what grows."""
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
        # The first children of all parents come before the second ones.
        parents = plan.source[rows[: len(rows) // 2]]
        left, right = (
            child_on_axis(context, parents, place, log(_KEPT), log(_FAINTER))
            for place in (-_APART, _APART)
        )
        return {name: Rows(torch.cat([left[name], right[name]]), rows) for name in left}


def child_on_axis(
    context: DensifyContext,
    parents: Tensor,
    place: Tensor | float,
    length: Tensor | float,
    opacity: Tensor | float,
) -> dict[str, Tensor]:
    """New values of a child of each parent [S] on its longest axis.

    Args:
        context: The step.
        parents: Rows of the parents.
        place: [S] of the child's middle from the parent's, standard deviations on the axis.
        length: [S] logarithm of its length there over the parent's.
        opacity: [S] logarithm of its opacity over the parent's.

    Source: fixed places on the longest axis as in Deng et al. 2024 (arXiv 2411.10133).
    """
    edited = ("means", "scales", "quats", "opacities")
    old = {name: context.parameters[name].detach()[parents] for name in edited}
    longest = old["scales"].argmax(dim=1)
    each = torch.arange(len(parents), device=parents.device)
    axis = rotation_matrices(old["quats"])[each, :, longest]
    width = torch.exp(old["scales"][each, longest])
    scales = old["scales"].clone()
    scales[each, longest] += length
    logarithm = logsigmoid(old["opacities"]) + opacity
    return {
        "means": old["means"] + axis * (place * width)[:, None],
        "scales": scales,
        "opacities": logarithm - torch.log(-torch.expm1(logarithm)),
    }
