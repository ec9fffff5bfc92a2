"""Density control by absolute screen gradients (AbsGS, Ye et al. 2024, arXiv 2404.10484)."""

from collections.abc import Mapping
from typing import Final, Literal

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, Selection, screen_statistics
from crossgrad_plugins.densifiers.clone_split import AxisSplit, Growth

#: Criterion -> the names of the thresholds that the criterion uses.
_THRESHOLDS: Final[Mapping[str, frozenset[str]]] = {
    "abs": frozenset({"grad_threshold", "abs_threshold"}),
    "gsplat": frozenset({"gsplat_threshold"}),
    "quantile": frozenset({"grad_threshold"}),
}


class AbsGradDensityControl(AxisSplit):
    """Adaptive density control by absolute gradients, in which opposite gradients cannot cancel.

    Let g be the norm of the gradient with respect to the projected mean. The densifier also sums
    the absolute values of the pixels' gradients in x and in y. ga is the norm of these two sums,
    averaged over the renders in which the Gaussian was visible. Criterion `abs` clones by g and
    splits by ga (AbsGS). Criterion `gsplat` clones and splits by ga alone. Criterion `quantile`
    first counts the N Gaussians whose g is above the threshold; these Gaussians and the N Gaussians
    with the largest ga are cloned or split. Criterion `quantile` computes ga as a 1-norm instead of
    a 2-norm, as in the code of Mip-Splatting.
    """

    needs = frozenset({"abs_gradient"})

    criterion: Literal["abs", "gsplat", "quantile"] = Field(
        "abs",
        description="statistics that select Gaussians to clone and to split: abs, gsplat or "
        "quantile",
    )
    grad_threshold: float = Field(2e-4, gt=0, description="of g: abs (clones) and quantile")
    abs_threshold: float = Field(4e-4, gt=0, description="of ga: abs (splits)")
    gsplat_threshold: float = Field(8e-4, gt=0, description="of ga: gsplat (clones and splits)")

    @override
    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        used = _THRESHOLDS[self.criterion]
        why = f"criterion {self.criterion} uses {' and '.join(sorted(used))}; leave the option out"
        unused = dict.fromkeys(frozenset().union(*_THRESHOLDS.values()) - used, why)
        return {**super().unused_options(selection), **unused}

    @property
    @override
    def by_size(self) -> bool:
        return self.criterion == "abs"

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        order = 1 if self.criterion == "quantile" else 2
        return PluginState(per_primitive=gradient_sums(context, state, order))

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        gradient = screen_statistics.mean(state.per_primitive, "gradient", "renders")
        absolute = screen_statistics.mean(state.per_primitive, "absolute", "renders")
        if self.criterion == "abs":
            clones = gradient >= self.grad_threshold
            splits = absolute >= self.abs_threshold
        elif self.criterion == "gsplat":
            clones = splits = absolute >= self.gsplat_threshold
        else:
            clones = splits = self._by_quantile(gradient, absolute)
        return Growth(clone=clones & small, split=splits & ~small, strength=absolute)

    def _by_quantile(self, gradient: Tensor, absolute: Tensor) -> Tensor:
        """Return [P], True if g >= threshold or if ga is at least its (1 - rho) quantile.

        rho is the share of primitives whose g is at least the threshold. If rho is 0, no primitive
        grows. A primitive that was never visible (ga = 0) does not grow either.
        """
        moves = gradient >= self.grad_threshold
        if not bool(moves.any()):
            return moves
        share = float(moves.double().mean())
        among_largest = absolute >= quantile(absolute, 1.0 - share)
        return moves | (among_largest & (absolute > 0))


def gradient_sums(context: DensifyContext, state: PluginState, order: int = 2) -> dict[str, Tensor]:
    """Return the sums [P] of g and of ga, and the number of renders that showed a primitive.

    The sums include the views of this step.

    Args:
        context: The context of the step.
        state: The state with the sums of earlier steps.
        order: Order of the norm of the two absolute sums: 1 or 2.
    """
    totals = screen_statistics.sums(context, state, ("gradient", "absolute", "renders"))
    for record in context.views:
        rows = screen_statistics.seen(record)
        norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record, rows), dim=1)
        absolute = torch.linalg.vector_norm(
            screen_statistics.ndc_abs_gradient(record, rows), ord=order, dim=1
        )
        drawn = screen_statistics.visible(record, rows)
        screen_statistics.add(record, totals["gradient"], norms * drawn, rows)
        screen_statistics.add(record, totals["absolute"], absolute * drawn, rows)
        screen_statistics.add(record, totals["renders"], drawn, rows)
    return totals


def quantile(values: Tensor, share: float) -> Tensor:
    """Return the quantile of `values` [P > 0] by linear interpolation.

    This function exists because `torch.quantile` accepts at most 2^24 values.
    """
    ordered = values.sort().values
    position = share * (len(ordered) - 1)
    below = int(position)
    above = min(below + 1, len(ordered) - 1)
    return torch.lerp(ordered[below], ordered[above], position - below)
