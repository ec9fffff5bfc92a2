"""3DGS-MCMC: relocation, growth to a cap, noise and regularisers (Kheradmand et al. 2024)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import log, pi, sqrt
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import (
    NO_EDIT,
    AfterStepContext,
    Densifier,
    DensifyContext,
    DensifyResult,
    Edit,
    Parameters,
    PluginState,
    RegularizeContext,
    RegularizeResult,
    Rows,
    Schedule,
    hookimpl,
)

#: Steepness of the sigmoid that gates the noise, and the opacity at which the gate is 1/2
#: (3DGS-MCMC).
GATE_STEEPNESS = 100.0
GATE_OPACITY = 0.005
#: Shifts below this share of a Gaussian's largest scale are skipped, because float32 hardly
#: represents them.
NEGLIGIBLE = 1e-7


def position_noise(
    parameters: Mapping[str, Tensor], strength: float, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return the rows of `means` that noise moves, and the shifts of these rows.

    shift = strength Sigma n sigmoid(-100 (o - 0.005)). Sigma is the covariance, o is the opacity,
    and n are three standard normal numbers. No number is drawn for a Gaussian that would move by
    less than 1e-7 of its largest scale. Opaque Gaussians move by less than this limit, so the noise
    costs little time after the first steps.

    Args:
        parameters: Parameters with `scales` (log) [N, 3], `quats` [N, 4] and `opacities` (logit)
            [N].
        strength: Learning rate of the positions times the factor of the noise, 1 / local units.
        rng: Random generator.

    Returns:
        Indices [R] int64 of the moved rows, and their shifts [R, 3] in local units.

    Source: Kheradmand et al. 2024 (3DGS-MCMC), eq. 8.
    """
    log_scales = parameters["scales"].detach()
    opacity = sigmoid(parameters["opacities"].detach())
    factor = strength * sigmoid(GATE_STEEPNESS * (GATE_OPACITY - opacity))
    # Process the three columns separately, because reductions over rows of three are slow on the
    # CPU.
    a, b, c = log_scales.unbind(1)
    largest = torch.exp(torch.maximum(torch.maximum(a, b), c))
    rows = (factor * largest > NEGLIGIBLE).nonzero().squeeze(1)
    draws = rng.standard_normal((rows.shape[0], 3), dtype=np.float32)
    noise = torch.from_numpy(draws).to(log_scales, non_blocking=True)
    axes = torch.nn.functional.normalize(parameters["quats"].detach()[rows], dim=-1)
    variances = torch.exp(2.0 * log_scales[rows])
    shifts = rotated(variances * rotated(noise, axes, back=True), axes)
    return rows, shifts * factor[rows, None]


def rotated(vectors: Tensor, quats: Tensor, *, back: bool = False) -> Tensor:
    """Return vectors [R, 3] rotated by unit quaternions wxyz [R, 4], or by their inverses.

    With quaternion (w, u) and vector v, the formula is v + w t + u x t with t = 2 u x v. It needs
    no matrices.
    """
    w, u = quats[:, :1], quats[:, 1:]
    turned: Tensor = 2.0 * torch.linalg.cross(u, vectors)
    along: Tensor = vectors + torch.linalg.cross(u, turned)
    return along - w * turned if back else along + w * turned


#: Maximum number n of copies for which the formula is evaluated (the published bound).
MOST_COPIES = 51
#: Step of the numerical integration, in standard deviations. The integrand is an entire function,
#: so the relative error of the trapezoidal rule decreases as exp(-c / step). For 51 opaque copies,
#: the error is 2e-12 at step 0.2. At step 0.15, it is below the rounding error.
_STEP = 0.15
#: Number of steps of the integration. The steps reach 9.6 standard deviations, where the integrand
#: of 51 copies is below 1e-18.
_STEPS = 64


def shared_opacity(opacity: Tensor, copies: Tensor) -> Tensor:
    """Return the opacity of n copies that together are as opaque as one: 1 - (1 - o)^(1/n).

    Args:
        opacity: [R] float64 opacity o of the original, in [0, 1].
        copies: [R] number n of copies, at least 1.
    """
    return -torch.expm1(torch.log1p(-opacity) / copies)


def shared_scale(opacity: Tensor, copies: Tensor) -> Tensor:
    """Return the factor of the scales with which n copies together are as wide as the original.

    Let o be the original opacity and o' the opacity of each copy (`shared_opacity`). The published
    factor is o / D with the alternating sums D = sum_{i=1..n} sum_{q<i} C(i-1, q) (-1)^q o'^(q+1) /
    sqrt(q+1). For many opaque copies, the alternating sums lose all precision by cancellation. But
    1 / sqrt(q+1) is an integral over exp(-x^2/2) to the power q+1. With the sums inside the
    integral,

        D = 1/sqrt(2 pi) int 1 - (1 - o' exp(-x^2/2))^n dx.

    The integrand is positive and smooth. The trapezoidal rule therefore integrates it up to
    rounding errors.

    Args:
        opacity: [R] float64 opacity o of the original, in [0, 1].
        copies: [R] number n of copies, 1 to 51.

    Returns:
        [R] factors in (0, 1]. If the opacity is 0 or subnormal, the result is the limit 1.
    """
    nodes = _STEP * torch.arange(_STEPS + 1, dtype=opacity.dtype, device=opacity.device)
    weights = torch.full_like(nodes, 2.0 * _STEP / sqrt(2.0 * pi))
    weights[0] /= 2.0
    alphas = shared_opacity(opacity, copies)[:, None] * torch.exp(-nodes * nodes / 2.0)
    covered = -torch.expm1(copies[:, None] * torch.log1p(-alphas))
    is_normal = opacity > torch.finfo(opacity.dtype).tiny
    return torch.where(is_normal, opacity / (covered @ weights), torch.ones_like(opacity))


@dataclass(frozen=True)
class Pool:
    """A list of primitives that can contain several copies of one original.

    Attributes:
        source: [M] int64 index of the original of each primitive.
        opacity: [M] float64 opacity of each primitive.
        scale: [M] float64 factor of the scales of each primitive.
        touched: [M] bool, True if another primitive has the same original.
    """

    source: Tensor
    opacity: Tensor
    scale: Tensor
    touched: Tensor

    @classmethod
    def of(cls, opacity: Tensor) -> "Pool":
        """Return the pool of the present primitives, with opacities [M] (float64)."""
        source = torch.arange(opacity.shape[0], device=opacity.device)
        untouched = torch.zeros_like(source, dtype=torch.bool)
        return cls(source, opacity, torch.ones_like(opacity), untouched)

    def copied(self, index: Tensor, lowest: float) -> "Pool":
        """Return the primitives at `index` [M'].

        Primitives that occur several times share their opacity.

        Args:
            index: [M'] int64 indices; an index may occur several times.
            lowest: Lower bound of a shared opacity; the upper bound is 1 minus the float32 epsilon.
        """
        copies = torch.bincount(index, minlength=self.source.shape[0]).clamp(max=MOST_COPIES)
        rows = (copies > 1).nonzero().squeeze(1)
        opacity, scale, touched = self.opacity.clone(), self.scale.clone(), self.touched.clone()
        highest = 1.0 - torch.finfo(torch.float32).eps
        opacity[rows] = shared_opacity(self.opacity[rows], copies[rows]).clamp(lowest, highest)
        scale[rows] *= shared_scale(self.opacity[rows], copies[rows])
        touched[rows] = True
        return Pool(self.source[index], opacity[index], scale[index], touched[index])


#: Relocation and growth end after the share 25,000 / 30,000 of the steps, as published.
LAST_EDIT_SHARE = 25 / 30


class MarkovChainMonteCarlo(Densifier):
    """Moves transparent Gaussians onto opaque ones, and adds 5 % per edit up to a cap.

    The densifier needs no screen statistics. Noise on the positions makes the Gaussians explore
    space like samples of a distribution. Two regularisers make Gaussians without use transparent
    and small. The densifier does not clone, split, prune or reset opacities.
    """

    tensors = frozenset({"means", "scales", "quats", "opacities"})
    resets: ClassVar[bool] = False
    observes: ClassVar[bool] = False

    cap: int = Field(1_000_000, ge=0, description="most Gaussians")
    growth: float = Field(0.05, ge=0, le=1, description="share of Gaussians added per edit")
    dead_opacity: float = Field(
        0.005, gt=0, lt=1, description="Gaussians with at most this opacity are relocated"
    )
    noise: float = Field(
        5e5, ge=0, description="noise added to positions, per learning rate; 0 for none"
    )
    opacity_weight: float = Field(0.01, ge=0, description="weight of the mean opacity in the loss")
    scale_weight: float = Field(
        0.01, ge=0, description="weight of the mean scale in the loss, per scene extent"
    )
    initial_opacity: float | None = Field(
        0.5, gt=0, lt=1, description="initial opacity; null uses the backbone's"
    )
    initial_scale: float = Field(0.1, gt=0, description="factor of the initial scales")

    @override
    def window(self, schedule: Schedule) -> Schedule:
        until = round(LAST_EDIT_SHARE * schedule.length)
        return replace(schedule.with_edits(until=until), reset_every=None)

    @override
    def started(self, parameters: Parameters) -> Parameters:
        scales = parameters["scales"].detach() + log(self.initial_scale)
        started = {**parameters, "scales": scales}
        if self.initial_opacity is not None:
            logit = log(self.initial_opacity / (1.0 - self.initial_opacity))
            started["opacities"] = torch.full_like(parameters["opacities"].detach(), logit)
        return started

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.densifies(context.step):
            return NO_EDIT, state
        pool = Pool.of(sigmoid(context.parameters["opacities"].detach().double()))
        before = pool.source.shape[0]
        wanted = max(0, min(self.cap, int((1.0 + self.growth) * before)) - before)
        pool, relocated = self._relocated(pool, context.rng)
        pool = self._grown(pool, min(wanted, context.room), context.rng)
        counts = {"relocated": relocated, "added": pool.source.shape[0] - before}
        if wanted > context.room:
            counts["held_back"] = wanted - context.room
        return _edit_of(pool, context.parameters["scales"].detach(), counts), state

    @hookimpl
    def crossgrad_after_step(self, context: AfterStepContext) -> DensifyResult | None:
        """Add noise to the positions; the optimizer's moments do not change."""
        strength = self.noise * context.means_lr
        rows, shifts = position_noise(context.parameters, strength, context.rng)
        if rows.shape[0] == 0:
            return None
        moved = context.parameters["means"].detach()[rows] + shifts
        return DensifyResult(Edit(values={"means": Rows(moved, rows, keep_moments=True)}))

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Return mean opacity and mean scale as a loss, once per step for any number of views."""
        opacities, scales = context.parameters["opacities"], context.parameters["scales"]
        if context.gaussians is not None or opacities.shape[0] == 0:
            return None
        opacity = self.opacity_weight * sigmoid(opacities).mean()
        return RegularizeResult(opacity + self.scale_weight * torch.exp(scales).mean())

    def _relocated(self, pool: Pool, rng: np.random.Generator) -> tuple[Pool, int]:
        """Move dead primitives onto live primitives; return the pool and the number moved."""
        dead = pool.opacity <= self.dead_opacity
        live = (~dead).nonzero().squeeze(1)
        moved = int(dead.sum())
        if moved == 0 or live.shape[0] == 0:
            return pool, 0
        index = torch.arange(dead.shape[0], device=dead.device)
        index[dead] = live[drawn(pool.opacity[live], moved, rng)]
        return pool.copied(index, self.dead_opacity), moved

    def _grown(self, pool: Pool, added: int, rng: np.random.Generator) -> Pool:
        """Return the pool with `added` copies; it is unchanged if no primitive can be copied."""
        if added == 0 or not bool((pool.opacity > 0.0).any()):
            return pool
        index = torch.arange(pool.opacity.shape[0], device=pool.opacity.device)
        more = drawn(pool.opacity, added, rng)
        return pool.copied(torch.cat([index, more]), self.dead_opacity)


def drawn(weights: Tensor, number: int, rng: np.random.Generator) -> Tensor:
    """Return [number] int64 random indices, with probability proportional to weights [M]."""
    shares = weights.cpu().numpy()
    indices = rng.choice(shares.shape[0], number, p=shares / shares.sum())
    return torch.from_numpy(indices).to(weights.device)


def _edit_of(pool: Pool, log_scales: Tensor, counts: dict[str, int]) -> Edit:
    """Return the edit that creates the pool; copies and their originals get zero moments."""
    if not bool(pool.touched.any()):
        return Edit(counts=counts) if any(counts.values()) else NO_EDIT
    rows = pool.touched.nonzero().squeeze(1)
    scales = log_scales[pool.source[rows]] + torch.log(pool.scale[rows])[:, None]
    opacities = torch.logit(pool.opacity[rows])
    values = {"opacities": Rows(opacities, rows), "scales": Rows(scales, rows)}
    return Edit(pool.source, pool.touched, values, counts)
