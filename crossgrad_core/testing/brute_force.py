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

from crossgrad_core.gaussians import Gaussians
from crossgrad_core.rasterizer import ALPHA_THRESHOLD, JACOBIAN_MARGIN, TRANSMITTANCE_STOP
from crossgrad_core.scene.types import Camera

Array: TypeAlias = NDArray[np.float64]

#: Determinants up to this (px^4) have no footprint in Mip-Splatting.
_MIP_EPSILON = 1e-6


@dataclass(frozen=True)
class Trace:
    """A render by brute force.

    Attributes:
        image: [H, W, 3] over a black background.
        alpha: [H, W].
        depth: [H, W] sum of weight times camera depth.
        touched: [N] bool, alpha >= 1/255 in some pixel.
        pixels: [N] pixels in which each Gaussian was blended.
        margins: Per rule, the smallest relative distance of a compared value from its threshold.
    """

    image: Array
    alpha: Array
    depth: Array
    touched: NDArray[np.bool_]
    pixels: NDArray[np.int64]
    margins: dict[str, float]


def trace(
    gaussians: Gaussians,
    camera: Camera,
    *,
    max_alpha: float = 0.99,
    near: float = 1e-3,
    dilation: float = 0.3,
) -> Trace:
    """Draws Gaussians over black, pixel arrays at a time.

    Args:
        gaussians: N Gaussians.
        camera: The camera.
        max_alpha: Cap of alpha.
        near: Near plane, local units.
        dilation: Used where the Gaussians bring none.
    """
    scene = _Scene(gaussians, camera, near, dilation)
    margins = {"alpha": np.inf, "cap": np.inf, "stop": np.inf, **scene.margins()}
    height, width = camera.height, camera.width
    image, alpha, depth = np.zeros((height, width, 3)), np.zeros((height, width)), 0.0
    transmittance = np.ones((height, width))
    stopped = np.zeros((height, width), bool)
    touched = np.zeros(len(gaussians), bool)
    pixels = np.zeros(len(gaussians), np.int64)
    for i in np.argsort(scene.local[:, 2], kind="stable"):
        raw = scene.alphas(int(i))
        touching = raw >= ALPHA_THRESHOLD
        capped = np.where(touching, np.minimum(raw, max_alpha), 0.0)
        behind = transmittance * (1 - capped)
        stopped |= touching & (behind < TRANSMITTANCE_STOP)
        weight = np.where(stopped, 0.0, capped * transmittance)
        margins["alpha"] = min(margins["alpha"], _gap(raw, ALPHA_THRESHOLD))
        margins["cap"] = min(margins["cap"], _gap(raw, max_alpha))
        margins["stop"] = min(margins["stop"], _gap(behind, TRANSMITTANCE_STOP))
        image += weight[..., None] * scene.colors[i].clip(0.0)
        alpha += weight
        depth = depth + weight * scene.local[i, 2]
        transmittance = np.where(stopped, transmittance, behind)
        touched[i] = touching.any()
        pixels[i] = (touching & ~stopped).sum()
    return Trace(image, alpha, np.broadcast_to(depth, alpha.shape), touched, pixels, margins)


class _Scene:
    """World to pixels, for one Gaussian at a time."""

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

    def covariance(self, i: int) -> Array:
        """[2, 2] of Gaussian i in pixels, without dilation."""
        x, y, z = self.local[i]
        sx, sy = np.clip([x / z, y / z], self.low, self.high)
        fx, fy = self.focals
        jacobian = np.array([[fx / z, 0, -fx * sx / z], [0, fy / z, -fy * sy / z]])
        axes = _rotation(self.quats[i])
        world = axes @ np.diag(self.scales[i] ** 2) @ axes.T
        return np.asarray(jacobian @ self.rotation @ world @ self.rotation.T @ jacobian.T)

    def alphas(self, i: int) -> Array:
        """[H, W] opacity times coverage of Gaussian i, before cap and threshold."""
        nothing = np.zeros(self.centers.shape[:2])
        if not self.local[i, 2] > self.near or not self.opacities[i] >= ALPHA_THRESHOLD:
            return nothing
        if not np.any(self.quats[i]):
            return nothing
        offset = self.centers - (
            self.focals * self.local[i, :2] / self.local[i, 2] + self.principal
        )
        covariance = self.covariance(i)
        if self.response == "analytic":
            return np.asarray(self.opacities[i] * _window_integral(offset, covariance))
        dilated = covariance + self.dilation * np.eye(2)
        opacity = self.opacities[i]
        if self.response == "antialiased":
            before, after = np.linalg.det(covariance), np.linalg.det(dilated)
            drawn = min(before, after) > _MIP_EPSILON
            opacity *= sqrt(before / (after + _MIP_EPSILON) + _MIP_EPSILON) if drawn else 0.0
        square = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(dilated), offset)
        return np.asarray(opacity * np.exp(-square / 2))

    def margins(self) -> dict[str, float]:
        """Distances from the thresholds that are met before any pixel."""
        ahead = self.local[:, 2] > self.near
        slopes = self.local[ahead, :2] / self.local[ahead, 2:]
        depths = np.sort(self.local[ahead, 2])
        gaps = {
            "near": _gap(self.local[:, 2], self.near),
            "order": _gap(depths[1:] / depths[:-1], 1.0),
            "opacity": _gap(self.opacities, ALPHA_THRESHOLD),
            "slope": min(
                float(np.abs(slopes - s).min(initial=np.inf)) for s in (self.low, self.high)
            ),
            "color": float(np.abs(self.colors).min(initial=np.inf)) if self.harmonic else np.inf,
        }
        if self.response != "plain":
            axes = [np.linalg.eigvalsh(self.covariance(int(i))) for i in np.flatnonzero(ahead)]
            spread = np.array(axes).reshape(-1, 2)
            gaps["axes"] = _gap(spread[:, 0] / spread[:, 1], 1.0)
            gaps["determinant"] = _gap(spread.prod(-1), _MIP_EPSILON)
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
    """[3, 3]: rotates each axis by q v q* of the normalised quaternion wxyz [4]."""
    w, v = quat[0] / np.linalg.norm(quat), quat[1:] / np.linalg.norm(quat)
    columns = [e + 2 * np.cross(v, np.cross(v, e) + w * e) for e in np.eye(3)]
    return np.stack(columns, -1)


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


def _gap(values: Array, threshold: float) -> float:
    """Smallest |log(value / threshold)| of positive values: their relative distance from it."""
    positive = values[values > 0]
    return float(np.abs(np.log(positive) - log(threshold)).min(initial=np.inf))


def _numpy(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().cpu().double().numpy())
