"""A backbone that extends vanilla by attributes that depend on the camera distance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.plugin import (
    Block,
    Camera,
    Gaussians,
    LearningRate,
    Parameters,
    Phase,
    RegularizeContext,
    RegularizeResult,
    Scene,
    Selection,
    hookimpl,
)

#: Minimum distance in local units. Without it, a camera at the mean centre would have no
#: logarithmic distance.
NEAREST = 1e-3
#: All distances count as equal if the standard deviation of their logarithms is below this value.
LEAST_SPREAD = 1e-6


@dataclass(frozen=True)
class Conditioned:
    """A tensor of the vanilla backbone that depends on the camera distance.

    Attributes:
        weights: Name of the tensor of weights [N, ..., 2].
        base: The block to which the weighted terms are added.
        shape: Shape of a primitive's weights; the product with D broadcasts to the base's shape.
    """

    weights: str
    base: str
    shape: tuple[int, ...]


SCALES = Conditioned("distance_scales", "scales", (1, 2))
OPACITIES = Conditioned("distance_opacities", "opacities", (2,))
COLORS = Conditioned("distance_f_dc", "f_dc", (1, 3, 2))


def fitted_scale(cameras: Sequence[Camera]) -> Tensor:
    """Return [7] float64: mean centre, mean and 1 / standard deviation of log r, range of z.

    The last three values are 0 if there is one camera or if all distances are equal.
    """
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.mean(0)
    logs = _log_distances(centers, middle)
    spread = logs.std(unbiased=False)
    inverse = 1.0 / spread if float(spread) > LEAST_SPREAD else torch.zeros_like(spread)
    z = (logs - logs.mean()) * inverse
    return torch.cat([middle, torch.stack([logs.mean(), inverse, z.min(), z.max()])])


def distinguished(scale: Tensor) -> bool:
    """Return True if the distances behind a result of `fitted_scale` differ."""
    return bool(scale[4] > 0)


def encoded(scale: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the encoding D = (z, z^2) [2], averaged over the cameras.

    z is the standardised log r of a camera, clamped to the range of the training cameras, because a
    quadratic does not extrapolate.
    """
    centers = torch.stack([camera.center for camera in cameras]).to(scale, non_blocking=True)
    z = (_log_distances(centers, scale[:3]) - scale[3]) * scale[4]
    z = torch.minimum(torch.maximum(z, scale[5]), scale[6])
    return torch.stack([z.mean(), z.square().mean()])


def added(weights: Tensor, encoding: Tensor) -> Tensor:
    """Return the terms [N, ...] that weights [N, ..., 2] add for an encoding [2].

    The code avoids a matrix product, because the rounding of a matrix product depends on the number
    of threads.
    """
    products: Tensor = weights * encoding
    return products.sum(-1)


def largest_addition(scale: Tensor, weights: Tensor) -> Tensor:
    """Return the maximum [N] of w_1 z + w_2 z^2 for weights [N, 2] within the range of z."""
    first, second = weights.unbind(1)
    least, most = scale[5:].to(weights)
    # The maximum of a parabola is at an end of the range, or at its vertex if it opens downwards.
    vertex = torch.where(second < 0, -first / (2 * second), least)
    vertex = torch.minimum(torch.maximum(vertex, least), most)
    sums: Tensor = torch.stack([z * first + z * z * second for z in (least, vertex, most)])
    return sums.amax(0)


def penalty(weights: Tensor, l2: float, smoothness: float) -> Tensor:
    """Compute the penalty on weights [N, ..., 2]: sum per Gaussian, mean over the Gaussians.

    The penalty is `l2` times the squared weights, plus `smoothness` times the squared derivative of
    w_1 z + w_2 z^2 with respect to z, averaged over the training cameras. Over these cameras z has
    mean 0 and variance 1, so the mean of (w_1 + 2 w_2 z)^2 is w_1^2 + 4 w_2^2.
    """
    factors = torch.tensor([l2 + smoothness, l2 + 4 * smoothness]).to(weights, non_blocking=True)
    total: Tensor = (weights.square() @ factors).sum()
    return total / max(1, len(weights))


def _log_distances(centers: Tensor, middle: Tensor) -> Tensor:
    distances: Tensor = torch.linalg.vector_norm(centers - middle, dim=1)
    return distances.clamp(min=NEAREST).log()


#: Name of the tensor that `fitted_scale` returns.
SCALE = "distances"


class DistanceConditioned(Vanilla):
    """The 3DGS representation with scales, opacities and colours linear in D = (z, z^2).

    z is the logarithm of the camera's distance from the mean training camera, standardised. Each
    Gaussian adds w . D to its log scales (the same term for all three scales), to its opacity logit
    and to each coefficient of SH band 0, with separate weights w for each of them. The weights
    start at 0, so that the model equals vanilla bit for bit. Two penalties on the weights grow
    linearly over the run: their squared length, and the squared derivative, with respect to z, of
    the terms that the weights add. Blocks: the blocks of vanilla, `distance_scales` [N, 1, 2],
    `distance_opacities` [N, 2], `distance_f_dc` [N, 1, 3, 2], and `distances` [7]. Source: the
    paper, Distance-Conditioned Attributes; the encoding and the default values were chosen for
    crossgrad.
    """

    plain: ClassVar[bool] = False
    passthrough: ClassVar[Mapping[str, str]] = {"sh_rest": "f_rest"}
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes

    condition_scales: bool = Field(True, description="whether scales depend on the distance")
    condition_opacities: bool = Field(True, description="whether opacities depend on the distance")
    condition_colors: bool = Field(True, description="whether SH band 0 depends on the distance")
    lr_share: float = Field(
        0.1,
        gt=0,
        description="learning rates of the weights, as shares of the learning rates of the "
        "tensors that they modify",
    )
    l2_weight: float = Field(
        0.01, ge=0, description="final weight of the mean squared weight in the loss"
    )
    smoothness_weight: float = Field(
        0.01,
        ge=0,
        description="final weight of the mean squared derivative by the log distance in the loss",
    )

    @override
    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        if self._conditioned():
            return super().unused_options(selection)
        why = "nothing depends on the distance (condition_* = false); leave the option out"
        names = ("lr_share", "l2_weight", "smoothness_weight")
        return {**super().unused_options(selection), **dict.fromkeys(names, why)}

    def _conditioned(self) -> tuple[Conditioned, ...]:
        chosen = (self.condition_scales, self.condition_opacities, self.condition_colors)
        choices = zip((SCALES, OPACITIES, COLORS), chosen, strict=True)
        return tuple(conditioned for conditioned, wanted in choices if wanted)

    @override
    def blocks(self) -> tuple[Block, ...]:
        plain = {block.name: block for block in super().blocks()}
        weights = []
        for conditioned in self._conditioned():
            base = plain[conditioned.base]
            rate = LearningRate(self.lr_share * base.lr.initial, few_passes=base.lr.few_passes)
            weights.append(
                Block(conditioned.weights, (conditioned.weights,), True, base.kind, rate)
            )
        scale = Block(SCALE, (SCALE,), False, "neutral", LearningRate(0.0))
        return (*plain.values(), *weights, scale)

    @override
    def fitted_to(self, scene: Scene) -> tuple[Vanilla, tuple[str, ...]]:
        """Leave out the distance terms if all training cameras are equally far away."""
        backbone, notes = super().fitted_to(scene)
        if distinguished(_scale_of(scene)):
            return backbone, notes
        names = ("condition_scales", "condition_opacities", "condition_colors")
        free = {name: False for name in names if name not in self.model_fields_set}
        note = (
            "distance conditioning is "
            + ("left out" if free else "without effect")
            + f": the {len(scene.train)} training cameras are equally far from their mean"
            + ("; --set backbone.condition_scales=true forces it" if free else "")
        )
        return backbone.model_copy(update=free), (*notes, note)

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        return self._conditionable(super().create(scene, rng), scene)

    @override
    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        return self._conditionable(super().adopt(gaussians, scene, rng), scene)

    def _conditionable(self, parameters: Parameters, scene: Scene) -> Parameters:
        rows = parameters["means"].shape[0]
        weights = {
            conditioned.weights: torch.zeros(rows, *conditioned.shape).requires_grad_()
            for conditioned in self._conditioned()
        }
        return {**parameters, **weights, SCALE: _scale_of(scene)}

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        return super().decode(self._seen_from(parameters, [camera]), camera, phase)

    def _seen_from(
        self, parameters: Mapping[str, Tensor], cameras: Sequence[Camera]
    ) -> dict[str, Tensor]:
        """Return the parameters of vanilla for the mean encoding of these cameras."""
        encoding = encoded(parameters[SCALE], cameras).to(parameters["means"])
        sums = {
            conditioned.base: parameters[conditioned.base]
            + added(parameters[conditioned.weights], encoding)
            for conditioned in self._conditioned()
        }
        return {**parameters, **sums}

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Return both penalties on the weights, once per step."""
        names = [conditioned.weights for conditioned in self._conditioned()]
        if context.gaussians is not None or not names:
            return None
        penalties = [
            penalty(context.parameters[name], self.l2_weight, self.smoothness_weight)
            for name in names
        ]
        return RegularizeResult(
            torch.stack(penalties).sum() * context.step / context.schedule.total
        )

    @override
    def capped_opacities(self, parameters: Mapping[str, Tensor], cap: float) -> Tensor:
        """Cap the opacity at the distance of its maximum."""
        if not self.condition_opacities:
            return super().capped_opacities(parameters, cap)
        most = largest_addition(parameters[SCALE], parameters[OPACITIES.weights].detach())
        limit = torch.logit(torch.tensor(cap, dtype=torch.float64)).item()
        return torch.minimum(parameters["opacities"].detach(), limit - most)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        return super().bake(self._seen_from(parameters, cameras), phase, cameras)


def _scale_of(scene: Scene) -> Tensor:
    return fitted_scale([view.camera for view in scene.train_views])
