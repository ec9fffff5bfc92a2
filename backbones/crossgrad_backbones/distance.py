"""A backbone that extends `vanilla` by attributes that depend on the camera distance."""

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

#: Smallest camera distance, in local units. Without this limit, the logarithm would be infinite for
#: a camera at the mean centre.
NEAREST = 1e-3
#: All camera distances count as equal if the standard deviation of their logarithms is below this
#: value.
LEAST_SPREAD = 1e-6


@dataclass(frozen=True)
class Conditioned:
    """A tensor of `vanilla` that depends on the camera distance.

    Attributes:
        weights: Name of the tensor that contains the weights [N, ..., 2].
        base: Name of the block to which the weighted terms are added.
        shape: Shape of the weights of one primitive. The product of the weights with D = (z, z^2)
            broadcasts to the shape of the base.
    """

    weights: str
    base: str
    shape: tuple[int, ...]


SCALES = Conditioned("distance_scales", "scales", (1, 2))
OPACITIES = Conditioned("distance_opacities", "opacities", (2,))
COLORS = Conditioned("distance_f_dc", "f_dc", (1, 3, 2))


def fitted_scale(cameras: Sequence[Camera]) -> Tensor:
    """Return [7] float64 with statistics of the camera distances.

    The values are the mean camera centre [3], mean and 1 / standard deviation of log r, and
    smallest and largest z. Here r is the distance of a camera from the mean centre, and z is the
    standardised log r.

    The last three values are 0 if only one camera exists or all distances are equal.
    """
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.mean(0)
    logs = _log_distances(centers, middle)
    spread = logs.std(unbiased=False)
    inverse = 1.0 / spread if float(spread) > LEAST_SPREAD else torch.zeros_like(spread)
    z = (logs - logs.mean()) * inverse
    return torch.cat([middle, torch.stack([logs.mean(), inverse, z.min(), z.max()])])


def distinguished(scale: Tensor) -> bool:
    """Return True if the camera distances differ. `scale` is a result of `fitted_scale`."""
    return bool(scale[4] > 0)


def encoded(scale: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the mean of D = (z, z^2) [2] over the cameras.

    z is the standardised log distance of a camera. z is limited to the range of the training
    cameras, because a quadratic function does not extrapolate well.
    """
    centers = torch.stack([camera.center for camera in cameras]).to(scale, non_blocking=True)
    z = (_log_distances(centers, scale[:3]) - scale[3]) * scale[4]
    z = torch.minimum(torch.maximum(z, scale[5]), scale[6])
    return torch.stack([z.mean(), z.square().mean()])


def added(weights: Tensor, encoding: Tensor) -> Tensor:
    """Return the terms [N, ...] that the weights [N, ..., 2] add for an encoding D [2].

    A matrix product is avoided, because its rounding depends on the number of threads.
    """
    products: Tensor = weights * encoding
    return products.sum(-1)


def largest_addition(scale: Tensor, weights: Tensor) -> Tensor:
    """Return the maximum [N] of w_1 z + w_2 z^2 over the range of z, for weights [N, 2]."""
    first, second = weights.unbind(1)
    least, most = scale[5:].to(weights)
    # The maximum of a parabola is at an end of the range or, if the parabola opens downwards, at
    # its vertex.
    vertex = torch.where(second < 0, -first / (2 * second), least)
    vertex = torch.minimum(torch.maximum(vertex, least), most)
    sums: Tensor = torch.stack([z * first + z * z * second for z in (least, vertex, most)])
    return sums.amax(0)


def penalty(weights: Tensor, l2: float, smoothness: float) -> Tensor:
    """Return the penalty on the weights [N, ..., 2]: the sum for each Gaussian, then the mean.

    The penalty is `l2` times the squared weights, plus `smoothness` times the mean squared
    derivative of w_1 z + w_2 z^2 with respect to z. Over the training cameras, z has mean 0 and
    variance 1. The mean of (w_1 + 2 w_2 z)^2 is therefore w_1^2 + 4 w_2^2.
    """
    factors = torch.tensor([l2 + smoothness, l2 + 4 * smoothness]).to(weights, non_blocking=True)
    total: Tensor = (weights.square() @ factors).sum()
    return total / max(1, len(weights))


def _log_distances(centers: Tensor, middle: Tensor) -> Tensor:
    distances: Tensor = torch.linalg.vector_norm(centers - middle, dim=1)
    return distances.clamp(min=NEAREST).log()


#: Name of the tensor that contains the result of `fitted_scale`.
SCALE = "distances"


class DistanceConditioned(Vanilla):
    """The 3DGS representation with scales, opacities and colours that are linear in D = (z, z^2).

    z is the standardised logarithm of the camera's distance from the mean of the training cameras.
    Each Gaussian has weights w, and the dot product of w and D is added to each attribute below.
    The attributes are the log scales (with a common term for all three), the opacity logit, and
    each coefficient of SH degree 0. Each attribute has its own weights. All weights start at 0, so
    that the initial model is bit-identical to `vanilla`. Two penalties on the weights increase
    linearly during the run: their squared length, and the squared derivative of the added terms
    with respect to z. Blocks: the blocks of `vanilla`, `distance_scales` [N, 1, 2],
    `distance_opacities` [N, 2], `distance_f_dc` [N, 1, 3, 2], and `distances` [7]. Source: arXiv
    2605.00052, Distance-Conditioned Attributes. crossgrad chose the encoding and the default
    values.
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
        description="final weight in the loss of the mean squared derivative with respect to the "
        "log distance",
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
        """Leave out the distance terms if all training cameras have the same distance."""
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
        """Return the parameters of `vanilla` for the mean encoding of the cameras."""
        encoding = encoded(parameters[SCALE], cameras).to(parameters["means"])
        sums = {
            conditioned.base: parameters[conditioned.base]
            + added(parameters[conditioned.weights], encoding)
            for conditioned in self._conditioned()
        }
        return {**parameters, **sums}

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Return the sum of both penalties on the weights, once in each step."""
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
        """Limit the opacity at the camera distance for which the opacity is largest."""
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
