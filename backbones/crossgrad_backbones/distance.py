"""Attributes that depend on how far the camera is: an extension of vanilla."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.distances import (
    COLORS,
    OPACITIES,
    SCALES,
    Conditioned,
    added,
    encoded,
    fitted_scale,
    largest_addition,
    penalty,
    told_apart,
)
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

#: Tensor of the scale that distances are measured on.
SCALE = "distances"


class DistanceConditioned(Vanilla):
    """The 3DGS representation with scales, opacities and colours linear in D = (z, z^2).

    z is the logarithm of the camera's distance from the mean training camera, standardised. To each
    log scale of a Gaussian (the same to all three), to its opacity logit and to each coefficient of
    SH band 0 it adds w . D with weights w of its own, zero at first: then it is vanilla bit for
    bit. Two penalties on the weights grow linearly over the run: their squared length, and the
    squared derivative of what they modulate by z. Blocks: those of vanilla, `distance_scales`
    [N, 1, 2], `distance_opacities` [N, 2], `distance_f_dc` [N, 1, 3, 2], and `distances` [7].
    Source: the paper, Distance-Conditioned Attributes; encoding and figures are ours.
    """

    plain: ClassVar[bool] = False
    passthrough: ClassVar[Mapping[str, str]] = {"sh_rest": "f_rest"}
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes

    condition_scales: bool = Field(True, description="scales depend on the distance")
    condition_opacities: bool = Field(True, description="opacities depend on the distance")
    condition_colors: bool = Field(True, description="SH band 0 depends on the distance")
    lr_share: float = Field(
        0.1, gt=0, description="learning rates of the weights, shares of those of what they add to"
    )
    l2_weight: float = Field(0.01, ge=0, description="final weight of the squared weights' mean")
    smoothness_weight: float = Field(
        0.01, ge=0, description="final weight of the squared derivative by the log distance"
    )

    @override
    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        if self._conditioned():
            return super().unused_options(selection)
        why = "nothing depends on the distance (condition_* = false); leave it out"
        names = ("lr_share", "l2_weight", "smoothness_weight")
        return {**super().unused_options(selection), **dict.fromkeys(names, why)}

    def _conditioned(self) -> tuple[Conditioned, ...]:
        chosen = (self.condition_scales, self.condition_opacities, self.condition_colors)
        each = zip((SCALES, OPACITIES, COLORS), chosen, strict=True)
        return tuple(conditioned for conditioned, wanted in each if wanted)

    @override
    def blocks(self) -> tuple[Block, ...]:
        plain = {block.name: block for block in super().blocks()}
        weights = []
        for each in self._conditioned():
            base = plain[each.base]
            rate = LearningRate(self.lr_share * base.lr.initial, hurried=base.lr.hurried)
            weights.append(Block(each.weights, (each.weights,), True, base.kind, rate))
        scale = Block(SCALE, (SCALE,), False, "neutral", LearningRate(0.0))
        return (*plain.values(), *weights, scale)

    @override
    def fitted_to(self, scene: Scene) -> tuple[Vanilla, tuple[str, ...]]:
        """Leaves conditions out where all training cameras are equally far from their mean."""
        backbone, notes = super().fitted_to(scene)
        if told_apart(_scale_of(scene)):
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
            each.weights: torch.zeros(rows, *each.shape).requires_grad_()
            for each in self._conditioned()
        }
        return {**parameters, **weights, SCALE: _scale_of(scene)}

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        return super().decode(self._seen_from(parameters, [camera]), camera, phase)

    def _seen_from(
        self, parameters: Mapping[str, Tensor], cameras: Sequence[Camera]
    ) -> dict[str, Tensor]:
        """Vanilla's parameters for the mean encoding of these cameras."""
        encoding = encoded(parameters[SCALE], cameras).to(parameters["means"])
        sums = {
            each.base: parameters[each.base] + added(parameters[each.weights], encoding)
            for each in self._conditioned()
        }
        return {**parameters, **sums}

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Both penalties on the weights, once per step."""
        names = [each.weights for each in self._conditioned()]
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
        """Caps the opacity at the distance where it is largest."""
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
