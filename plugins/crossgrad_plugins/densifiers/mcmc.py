"""3DGS-MCMC: relocation, slow growth to a cap, noise and regularisers (Kheradmand et al. 2024)."""

from dataclasses import replace
from math import log
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
from crossgrad_plugins.densifiers.position_noise import position_noise
from crossgrad_plugins.densifiers.relocation import Pool

#: Relocation and growth end after 25,000 of 30,000 steps (published).
LAST_EDIT_SHARE = 25 / 30


class MarkovChainMonteCarlo(Densifier):
    """Moves transparent Gaussians onto opaque ones and adds 5 % per pass up to a cap.

    Needs no screen statistics: Gaussians are samples of a distribution that training explores by
    noise of the positions, and two regularisers make those transparent and small that are of no
    use. There is no clone, split, prune or opacity reset.
    """

    tensors = frozenset({"means", "scales", "quats", "opacities"})
    resets: ClassVar[bool] = False
    observes: ClassVar[bool] = False

    cap: int = Field(1_000_000, ge=0, description="most Gaussians")
    growth: float = Field(0.05, ge=0, le=1, description="share added per pass")
    dead_opacity: float = Field(0.005, gt=0, lt=1, description="relocated at or below")
    noise: float = Field(5e5, ge=0, description="noise of positions, per learning rate; 0 for none")
    opacity_weight: float = Field(0.01, ge=0, description="weight of the mean opacity in the loss")
    scale_weight: float = Field(
        0.01, ge=0, description="weight of the mean scale in the loss, per scene extent"
    )
    initial_opacity: float | None = Field(
        0.5, gt=0, lt=1, description="opacity at the start; none keeps the backbone's"
    )
    initial_scale: float = Field(0.1, gt=0, description="factor of the scales at the start")

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
        """Moves the positions by noise; the moments stay."""
        strength = self.noise * context.means_lr
        rows, shifts = position_noise(context.parameters, strength, context.rng)
        if rows.shape[0] == 0:
            return None
        moved = context.parameters["means"].detach()[rows] + shifts
        return DensifyResult(Edit(values={"means": Rows(moved, rows, keep_moments=True)}))

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Mean opacity and mean scale, once per step however many views it has."""
        opacities, scales = context.parameters["opacities"], context.parameters["scales"]
        if context.gaussians is not None or opacities.shape[0] == 0:
            return None
        opacity = self.opacity_weight * sigmoid(opacities).mean()
        return RegularizeResult(opacity + self.scale_weight * torch.exp(scales).mean())

    def _relocated(self, pool: Pool, rng: np.random.Generator) -> tuple[Pool, int]:
        """The pool with dead primitives moved onto live ones, and how many were moved."""
        dead = pool.opacity <= self.dead_opacity
        live = (~dead).nonzero().squeeze(1)
        moved = int(dead.sum())
        if moved == 0 or live.shape[0] == 0:
            return pool, 0
        index = torch.arange(dead.shape[0], device=dead.device)
        index[dead] = live[drawn(pool.opacity[live], moved, rng)]
        return pool.copied(index, self.dead_opacity), moved

    def _grown(self, pool: Pool, added: int, rng: np.random.Generator) -> Pool:
        """The pool with `added` copies, where there is anything to copy."""
        if added == 0 or not bool((pool.opacity > 0.0).any()):
            return pool
        index = torch.arange(pool.opacity.shape[0], device=pool.opacity.device)
        more = drawn(pool.opacity, added, rng)
        return pool.copied(torch.cat([index, more]), self.dead_opacity)


def drawn(weights: Tensor, number: int, rng: np.random.Generator) -> Tensor:
    """[number] int64 indices, drawn independently with probability proportional to weights [M]."""
    shares = weights.cpu().numpy()
    indices = rng.choice(shares.shape[0], number, p=shares / shares.sum())
    return torch.from_numpy(indices).to(weights.device)


def _edit_of(pool: Pool, log_scales: Tensor, counts: dict[str, int]) -> Edit:
    """The pool as an edit; everything that shares a source starts with zero moments."""
    if not bool(pool.touched.any()):
        return Edit(counts=counts) if any(counts.values()) else NO_EDIT
    rows = pool.touched.nonzero().squeeze(1)
    scales = log_scales[pool.source[rows]] + torch.log(pool.scale[rows])[:, None]
    opacities = torch.logit(pool.opacity[rows])
    values = {"opacities": Rows(opacities, rows), "scales": Rows(scales, rows)}
    return Edit(pool.source, pool.touched, values, counts)
