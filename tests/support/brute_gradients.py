"""Gradients of single pixels by the projected means, written down a second time: slow, float64."""

from dataclasses import dataclass

import numpy as np
from support.brute_force import Array, Splatter, Trace, trace
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera

#: Step of the difference quotients, in standard deviations of the narrower axis.
_STEP = 1e-4


@dataclass(frozen=True)
class PixelGradients:
    """What each pixel's loss has to do with each Gaussian's place.

    Attributes:
        gradients: [N, H, W, 2] of the loss of the pixel by the projected mean.
        along: [N, H, W] place of the pixel centre along the Gaussian's longest axis, in standard
            deviations of its projection; 0 where the axis is seen end on.
        doubt: [N, H, W] sum of the absolute values of the two terms that make up the loss' gradient
            by alpha, over the absolute value of the latter.
    """

    gradients: Array
    along: Array
    doubt: Array

    def directions(self, size: tuple[int, int]) -> Array:
        """[N, 6, 5] of `Screen.directions`, pixel by pixel.

        Args:
            size: Width and height of the image.
        """
        result = np.zeros((len(self.along), 6, 5))
        for i, y, x in np.argwhere(self.gradients.any(-1)):
            gradient = self.gradients[i, y, x]
            unit = gradient * np.array(size)
            unit = unit / np.hypot(*unit)
            number = sum(self.along[i, y, x] >= edge for edge in (-2, -1, 0, 1, 2))
            result[i, number] += [*unit, *np.abs(gradient), 1.0]
        return result


def pixel_gradients(
    gaussians: Gaussians,
    camera: Camera,
    *,
    weights: dict[str, Tensor],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    max_alpha: float = 0.99,
    near: float = 1e-3,
    dilation: float = 0.3,
    drawn: Trace | None = None,
) -> PixelGradients:
    """The gradients of sum over `image`, `alpha` and `depth` of weight times value.

    Args:
        gaussians: N Gaussians, all finite.
        camera: The camera.
        weights: `image` [H, W, 3], and `alpha`, `depth` [H, W, 1] where wanted.
        background: RGB.
        max_alpha: Cap of alpha.
        near: Near plane, local units.
        dilation: Used where the Gaussians bring none.
        drawn: The trace of all this, where it is known.
    """
    drawn = drawn or trace(gaussians, camera, max_alpha=max_alpha, near=near, dilation=dilation)
    scene = Splatter(gaussians, camera, near, dilation)
    slopes, doubt = _by_alpha(drawn, weights, np.array(background), max_alpha)
    gradients = np.zeros((*slopes.shape, 2))
    for i in np.flatnonzero(slopes.any((1, 2))):
        gradients[i] = slopes[i][..., None] * _by_mean(scene, int(i))
    return PixelGradients(gradients, places(gaussians, camera), doubt)


def places(gaussians: Gaussians, camera: Camera) -> Array:
    """[N, H, W] of `PixelGradients.along`; 0 for what is not in front of the camera."""
    scene = Splatter(gaussians, camera, near=0.0, dilation=0.0)
    result = np.zeros((len(gaussians), camera.height, camera.width))
    for i in np.flatnonzero(scene.local[:, 2] > 0):
        if scene.quats[i].any():
            result[i] = _along(scene, int(i))
    return result


def _by_alpha(
    drawn: Trace, weights: dict[str, Tensor], background: Array, max_alpha: float
) -> tuple[Array, Array]:
    """[N, H, W] gradient by alpha, 0 where it is capped or not blended; and its doubt."""
    image = weights["image"].double().numpy()
    flat = {n: w.double().numpy()[..., 0] for n, w in weights.items() if n != "image"}
    by_alpha, by_depth = (flat.get(name, 0.0) for name in ("alpha", "depth"))
    slopes, doubt = np.zeros_like(drawn.raw), np.ones_like(drawn.raw)
    transmittance = np.ones(drawn.alpha.shape)
    # Front to back, with what lies in front; the rest of the sum lies behind.
    order = np.argsort(drawn.depths, kind="stable")
    alphas = np.where(drawn.blended, np.minimum(drawn.raw, max_alpha), 0.0)
    left = (image * (drawn.image + (1 - drawn.alpha)[..., None] * background)).sum(-1)
    left += by_alpha * drawn.alpha + by_depth * drawn.depth
    # alpha = 1 - transmittance: its gradient is that of minus what passes everything.
    left -= by_alpha
    for i in order:
        value = image @ drawn.colors[i] + by_depth * drawn.depths[i]
        left = left - alphas[i] * transmittance * value
        ahead, behind = transmittance * value, left / (1 - alphas[i])
        free = drawn.blended[i] & (drawn.raw[i] <= max_alpha)
        slopes[i] = np.where(free, ahead - behind, 0.0)
        terms = np.abs(ahead) + np.abs(behind)
        doubt[i] = np.divide(terms, np.abs(slopes[i]), out=doubt[i], where=slopes[i] != 0)
        transmittance = transmittance * (1 - alphas[i])
    return slopes, doubt


def _by_mean(scene: Splatter, i: int) -> Array:
    """[H, W, 2] derivative of alpha by the projected mean of Gaussian i, by differences."""
    covariance = scene.covariance(i)
    if scene.response != "analytic":
        covariance = covariance + scene.dilation * np.eye(2)
    step = _STEP * max(np.sqrt(np.linalg.eigvalsh(covariance)[0]), 1e-3)
    centers, result = scene.centers, []
    for axis in np.eye(2):
        scene.centers = centers + step * axis
        ahead = scene.alphas(i)
        scene.centers = centers - step * axis
        # To move the mean is to move the pixels the other way.
        result.append((scene.alphas(i) - ahead) / (2 * step))
    scene.centers = centers
    return np.stack(result, -1)


def _along(scene: Splatter, i: int) -> Array:
    axis = scene.jacobian(i) @ scene.axes(i)[:, np.argmax(scene.scales[i])]
    square = axis @ axis
    if square <= 1e-6**2:
        return np.zeros(scene.centers.shape[:2])
    return np.asarray((scene.centers - scene.mean(i)) @ axis / square)
