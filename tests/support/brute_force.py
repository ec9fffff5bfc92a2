"""The rasterizers' rule set written down a second time: float64, one Gaussian after the other.

Slow, without gradients and without a line in common with any rasterizer. It serves as the check of
the forward pass, and tells how near a scene comes to the thresholds of the rules.
"""

from dataclasses import dataclass
from math import factorial, log, pi, sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.numerics.raster_constants import (
    ALPHA_THRESHOLD,
    JACOBIAN_MARGIN,
    TRANSMITTANCE_STOP,
)

Array: TypeAlias = NDArray[np.float64]

#: Determinants up to this (px^4) have no footprint in Mip-Splatting.
_MIP_EPSILON = 1e-6


@dataclass(frozen=True)
class Trace:
    """A render by brute force.

    A *gap* is the relative distance of a compared value from its threshold, the smallest where
    several values are compared.

    Attributes:
        image: [H, W, 3] over a black background.
        alpha: [H, W].
        depth: [H, W] sum of weight times camera depth.
        raw: [N, H, W] alpha before the cap and the threshold.
        blended: [N, H, W] bool.
        colors: [N, 3] as drawn.
        depths: [N] camera depths of the centres.
        extents: [N] half-extent of each footprint, pixels.
        pixel_gaps: [H, W] of what is compared per pixel: alpha, cap and stop.
        gaussian_gaps: [N] of what is compared per Gaussian: near plane, opacity, order, clamps of
            the Jacobian and of colours, and the special cases of the response.
    """

    image: Array
    alpha: Array
    depth: Array
    raw: Array
    blended: NDArray[np.bool_]
    colors: Array
    depths: Array
    extents: Array
    pixel_gaps: Array
    gaussian_gaps: Array

    @property
    def touched(self) -> NDArray[np.bool_]:
        """[N] alpha >= 1/255 in some pixel."""
        return np.asarray((self.raw >= ALPHA_THRESHOLD).any((1, 2)))

    @property
    def pixels(self) -> NDArray[np.int64]:
        """[N] pixels in which each Gaussian was blended."""
        return np.asarray(self.blended.sum((1, 2)))


def trace(
    gaussians: Gaussians,
    camera: Camera,
    *,
    max_alpha: float = 0.99,
    near: float = 1e-3,
    dilation: float = 0.3,
) -> Trace:
    """Draws Gaussians over black, one after the other.

    Args:
        gaussians: N Gaussians, all finite.
        camera: The camera.
        max_alpha: Cap of alpha.
        near: Near plane, local units.
        dilation: Used where the Gaussians bring none.
    """
    scene = Splatter(gaussians, camera, near, dilation)
    number, size = len(gaussians), (camera.height, camera.width)
    image, alpha, depth = np.zeros((*size, 3)), np.zeros(size), np.zeros(size)
    raw, blended = np.zeros((number, *size)), np.zeros((number, *size), bool)
    transmittance, stopped = np.ones(size), np.zeros(size, bool)
    gaps = np.full(size, np.inf)
    for i in np.argsort(scene.local[:, 2], kind="stable"):
        raw[i] = scene.alphas(int(i))
        touching = raw[i] >= ALPHA_THRESHOLD
        capped = np.where(touching, np.minimum(raw[i], max_alpha), 0.0)
        behind = transmittance * (1 - capped)
        for values, threshold in ((raw[i], ALPHA_THRESHOLD), (raw[i], max_alpha)):
            gaps = np.minimum(gaps, np.where(stopped, np.inf, _gaps(values, threshold)))
        gaps = np.minimum(gaps, np.where(stopped, np.inf, _gaps(behind, TRANSMITTANCE_STOP)))
        stopped |= touching & (behind < TRANSMITTANCE_STOP)
        blended[i] = touching & ~stopped
        weight = np.where(blended[i], capped * transmittance, 0.0)
        image += weight[..., None] * scene.colors[i].clip(0.0)
        alpha += weight
        depth += weight * scene.local[i, 2]
        transmittance = np.where(stopped, transmittance, behind)
    brought = (scene.colors.clip(0.0), scene.local[:, 2], scene.extents())
    return Trace(*(image, alpha, depth, raw, blended), *brought, gaps, scene.gaps())


class Splatter:
    """World to pixels, for one Gaussian at a time.

    Args:
        gaussians: N Gaussians.
        camera: The camera.
        near: Near plane, local units.
        dilation: Used where the Gaussians bring none.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, near: float, dilation: float) -> None:
        self.camera = camera
        self.response = gaussians.response
        self.near = near
        self.dilation = dilation if gaussians.dilation is None else gaussians.dilation
        pose = _numpy(camera.world_to_camera)
        self.rotation = pose[:3, :3]
        self.local = _numpy(gaussians.means) @ self.rotation.T + pose[:3, 3]
        self.quats = _numpy(gaussians.quats)
        self.scales = _numpy(gaussians.scales)
        self.opacities = _numpy(gaussians.opacities)
        self.colors = _colors(gaussians, -self.rotation.T @ pose[:3, 3])
        self.harmonic = gaussians.colors is None
        self.focals = np.array([camera.fx, camera.fy])
        self.principal = np.array([camera.cx, camera.cy])
        size = np.array([camera.width, camera.height])
        margin = JACOBIAN_MARGIN * size / (2 * self.focals)
        self.low = -self.principal / self.focals - margin
        self.high = (size - self.principal) / self.focals + margin
        x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        self.centers = np.stack(np.meshgrid(x, y), -1)  # [H, W, 2]
        self._covariances: dict[int, Array] = {}

    def jacobian(self, i: int) -> Array:
        """[2, 3] of the projection at Gaussian i, world to pixels."""
        x, y, z = self.local[i]
        sx, sy = np.clip([x / z, y / z], self.low, self.high)
        fx, fy = self.focals
        local = np.array([[fx / z, 0, -fx * sx / z], [0, fy / z, -fy * sy / z]])
        return np.asarray(local @ self.rotation)

    def axes(self, i: int) -> Array:
        """[3, 3] the axes of Gaussian i as columns, one standard deviation long, world."""
        return np.asarray(_rotation(self.quats[i]) @ np.diag(self.scales[i]))

    def mean(self, i: int) -> Array:
        """[2] projected mean of Gaussian i, pixels."""
        return np.asarray(self.focals * self.local[i, :2] / self.local[i, 2] + self.principal)

    def covariance(self, i: int) -> Array:
        """[2, 2] of Gaussian i in pixels, without dilation."""
        if i not in self._covariances:
            flat = self.jacobian(i) @ self.axes(i)
            self._covariances[i] = flat @ flat.T
        return self._covariances[i]

    def mip_factor(self, covariance: Array) -> float:
        """Factor of the opacity: 1 unless the response is antialiased."""
        if self.response != "antialiased":
            return 1.0
        before = np.linalg.det(covariance)
        after = np.linalg.det(covariance + self.dilation * np.eye(2))
        if min(before, after) <= _MIP_EPSILON:
            return 0.0
        return sqrt(before / (after + _MIP_EPSILON) + _MIP_EPSILON)

    def alphas(self, i: int) -> Array:
        """[H, W] opacity times coverage of Gaussian i, before cap and threshold."""
        nothing = np.zeros(self.centers.shape[:2])
        if not self.local[i, 2] > self.near or not self.opacities[i] >= ALPHA_THRESHOLD:
            return nothing
        if not np.any(self.quats[i]):
            return nothing
        offset = self.centers - self.mean(i)
        covariance = self.covariance(i)
        if self.response == "analytic":
            return np.asarray(self.opacities[i] * _window_integral(offset, covariance))
        dilated = covariance + self.dilation * np.eye(2)
        opacity = self.opacities[i] * self.mip_factor(covariance)
        (a, b), (_, c) = np.linalg.inv(dilated)
        x, y = offset[..., 0], offset[..., 1]
        square = a * x * x + 2 * b * x * y + c * y * y
        return np.asarray(opacity * np.exp(-square / 2))

    def extents(self) -> Array:
        """[N] larger half-extent of the ellipse alpha = 1/255, pixels; NaN where there is none."""
        result = np.full(len(self.local), np.nan)
        for i in np.flatnonzero(self.local[:, 2] > self.near):
            covariance = self.covariance(int(i))
            opacity = self.opacities[i]
            if self.response != "analytic":
                opacity *= self.mip_factor(covariance)
                covariance = covariance + self.dilation * np.eye(2)
            if opacity >= ALPHA_THRESHOLD:
                contrast = log(opacity / ALPHA_THRESHOLD)
                result[i] = sqrt(2 * contrast * max(covariance[0, 0], covariance[1, 1]))
        return result

    def gaps(self) -> Array:
        """[N] distances from the thresholds that are met before any pixel."""
        depths = self.local[:, 2]
        gaps = np.minimum(_gaps(depths, self.near), _gaps(self.opacities, ALPHA_THRESHOLD))
        if self.harmonic:
            gaps = np.minimum(gaps, np.abs(self.colors).min(-1))
        ahead = np.flatnonzero(depths > self.near)
        order = ahead[np.argsort(depths[ahead])]
        # Of two Gaussians at nearly one depth, the farther has the gap.
        gaps[order[1:]] = np.minimum(gaps[order[1:]], np.diff(depths[order]) / depths[order[1:]])
        for i in ahead:
            slopes = self.local[i, :2] / depths[i]
            bounds = [self.low, self.high]
            gaps[i] = min(gaps[i], float(np.abs(slopes - bounds).min()))
            if self.response != "plain":
                smaller, larger = np.linalg.eigvalsh(self.covariance(int(i)))
                gaps[i] = min(gaps[i], 1 - smaller / larger)
                gaps[i] = min(gaps[i], float(_gaps(smaller * larger, _MIP_EPSILON)))
        return gaps


def _window_integral(offset: Array, covariance: Array) -> Array:
    """Analytic-Splatting's share of a Gaussian in the pixel turned onto its axes."""
    values, axes = np.linalg.eigh(covariance)
    result = np.ones(offset.shape[:2])
    for j in range(2):
        sigma = max(sqrt(abs(values[j])), 1e-3)
        along = offset @ axes[:, j]
        window = _cumulative((along + 0.5) / sigma) - _cumulative((along - 0.5) / sigma)
        result *= sqrt(2 * pi) * sigma * window
    return result


def _cumulative(x: Array) -> Array:
    return np.asarray((1 + np.tanh((1.6 * x + 0.07 * x**3) / 2)) / 2)


def _rotation(quat: Array) -> Array:
    """[3, 3] rotation of a quaternion wxyz [4] of any length, by Rodrigues' formula."""
    w, x, y, z = quat / np.linalg.norm(quat)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _colors(gaussians: Gaussians, center: Array) -> Array:
    """[N, 3] RGB before the clamp at 0."""
    if gaussians.colors is not None:
        return _numpy(gaussians.colors)
    assert gaussians.sh_dc is not None
    rays = _numpy(gaussians.means) - center
    z = rays[:, 2] / np.linalg.norm(rays, axis=-1)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    coefficients = [_numpy(gaussians.sh_dc)]
    if gaussians.sh_rest is not None:
        coefficients.append(_numpy(gaussians.sh_rest))
    bands = np.concatenate(coefficients, 1)
    colors = np.full((len(gaussians), 3), 0.5)
    index = 0
    for degree in range(gaussians.sh_degree + 1):
        for order in range(-degree, degree + 1):
            colors += _harmonic(degree, order, z, azimuth)[:, None] * bands[:, index]
            index += 1
    return colors


def _harmonic(degree: int, order: int, z: Array, azimuth: Array) -> Array:
    """[N] real spherical harmonic with the Condon-Shortley phase."""
    from scipy.special import lpmv

    m = abs(order)
    scale = (2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m)
    wave = np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth)
    return np.asarray(sqrt(scale * (2 if m else 1)) * lpmv(m, degree, z) * wave)


def _gaps(values: Array, threshold: float) -> Array:
    """|log(value / threshold)| of positive values, else infinity."""
    positive = np.where(values > 0, values, np.inf)
    return np.asarray(np.abs(np.log(positive) - log(threshold)))


def _numpy(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().cpu().double().numpy())
