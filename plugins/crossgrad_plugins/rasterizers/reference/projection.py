"""Projection from the world to the image (EWA splatting), and the response in a pixel.

A response consists of two functions. The first function converts a projection to a `Shape`. The
second function converts the offset between mean and pixel centre to a coverage, so that alpha =
min(max_alpha, opacity * coverage).
"""

from dataclasses import dataclass
from math import pi, sqrt

import torch
from torch import Tensor

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, JACOBIAN_MARGIN
from crossgrad_core.numerics.rotations import unit_rotation_matrices
from crossgrad_core.plugin import Camera, Response

#: Mip-Splatting does not render Gaussians whose 2-D determinant is at most this value, px^4.
MIP_EPSILON = 1e-6
#: Minimum standard deviation along an axis of the analytic response, px.
SIGMA_FLOOR = 1e-3
#: Analytic-Splatting approximates the normal distribution by sigmoid(LINEAR x + CUBIC x^3).
LINEAR, CUBIC = 1.6, 0.07


@dataclass(frozen=True)
class Projection:
    """N Gaussians in the image plane, before any dilation.

    Attributes:
        means: [N, 2] projected means, pixels.
        depths: [N] depth of the centre in the camera frame, local units.
        xx: [N] entry of the 2-D covariance, px^2.
        xy: [N] entry of the 2-D covariance, px^2.
        yy: [N] entry of the 2-D covariance, px^2.
        det: [N] determinant of the 2-D covariance, px^4; never negative.
        factors: [N, 2, 3] projections of the three axes, one standard deviation long, pixels.
    """

    means: Tensor
    depths: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor
    det: Tensor
    factors: Tensor


def project(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> Projection:
    """Project Gaussians by the local affine approximation (EWA, Zwicker et al. 2001).

    No Gaussian is culled here. If a Gaussian is behind the camera or has a zero quaternion, its row
    is meaningless and may be non-finite. The caller must leave out such rows.

    Args:
        means: [N, 3] centres, local units.
        quats: [N, 4] rotations wxyz, any length.
        scales: [N, 3] standard deviations, local units.
        camera: The camera, which is converted to the data type of `means`.
    """
    pose = camera.world_to_camera.to(means, non_blocking=True)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    slope_x, slope_y = x / z, y / z
    u = camera.fx * slope_x + camera.cx
    v = camera.fy * slope_y + camera.cy

    # Limit the slopes x / z and y / z. Far outside the image, the affine approximation is useless
    # and its Jacobian becomes very large.
    slope_x = slope_x.clamp(*_slopes(camera.width, camera.fx, camera.cx))
    slope_y = slope_y.clamp(*_slopes(camera.height, camera.fy, camera.cy))
    zero = torch.zeros_like(z)
    row_u = torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], -1)
    row_v = torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], -1)
    jacobian = torch.stack([row_u, row_v], 1)

    # The covariance is factor @ factor.T. If the quaternion is zero, all values are NaN.
    axes = unit_rotation_matrices(quats / quats.norm(dim=-1, keepdim=True)) * scales[:, None, :]
    factor = jacobian @ pose[:3, :3] @ axes
    first, second = factor.unbind(1)
    # Use the Cauchy-Binet formula, because it is a sum of squares. The formula xx * yy - xy^2 would
    # lose precision for very thin Gaussians.
    det = torch.linalg.cross(first, second).square().sum(-1)
    xx, xy, yy = first.square().sum(-1), (first * second).sum(-1), second.square().sum(-1)
    return Projection(torch.stack([u, v], -1), z, xx, xy, yy, det, factor)


def _slopes(size: int, focal: float, center: float) -> tuple[float, float]:
    """Return the allowed range of x / z in the Jacobian: the image with a margin around it."""
    margin = JACOBIAN_MARGIN * size / (2 * focal)
    return -center / focal - margin, (size - center) / focal + margin


@dataclass(frozen=True)
class Shape:
    """The footprints of N Gaussians in the image.

    Attributes:
        parameters: [N, S] input of `coverage`: the conic (a, b, c); for the analytic response,
            (cosine, sine, sigma1, sigma2) of the main axes.
        opacities: [N] factor of the coverage in alpha.
        peaks: [N] alpha at the mean, before the cap.
        reach: [N, 2] half-extents in pixels of a box that contains every pixel centre with
            alpha >= 1/255.
        radii: [N] reported half-extent, pixels.
    """

    parameters: Tensor
    opacities: Tensor
    peaks: Tensor
    reach: Tensor
    radii: Tensor


def shape(projection: Projection, opacities: Tensor, dilation: float, response: Response) -> Shape:
    """Return the footprints of projected Gaussians with `opacities` [N].

    The analytic response does not use the dilation.
    """
    if response == "analytic":
        return _windowed(projection, opacities)
    xx, yy = projection.xx + dilation, projection.yy + dilation
    det = projection.det + dilation * (projection.xx + projection.yy) + dilation**2
    if response == "antialiased":
        opacities = opacities * _mip_factor(projection.det, det)
    conic = torch.stack([yy / det, -projection.xy / det, xx / det], -1)
    # The curve alpha = 1/255 is an ellipse. `reach` contains the exact half-extents of this
    # ellipse.
    reach = (2 * _log_contrast(opacities)[:, None] * torch.stack([xx, yy], -1)).sqrt()
    return Shape(conic, opacities, opacities, reach, reach.amax(-1))


def coverage(dx: Tensor, dy: Tensor, parameters: Tensor, response: Response) -> Tensor:
    """Return [P, N] the share of its opacity that each Gaussian contributes to each pixel.

    Args:
        dx: [P, N] x of the mean minus x of the pixel centre, pixels.
        dy: [P, N] y of the mean minus y of the pixel centre, pixels.
        parameters: [N, S] the field of `Shape`.
        response: The response to which the parameters belong.
    """
    if response == "analytic":
        cosine, sine, sigma1, sigma2 = parameters.unbind(-1)
        u = cosine * dx + sine * dy
        v = cosine * dy - sine * dx
        return 2 * pi * sigma1 * sigma2 * _window(u, sigma1) * _window(v, sigma2)
    a, b, c = parameters.unbind(-1)
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    # Only rounding can make the power positive. The clamp then keeps exp and its gradient finite.
    return power.clamp(max=0.0).exp() * (power <= 0)


def _mip_factor(before: Tensor, after: Tensor) -> Tensor:
    """Return the opacity factor that compensates for the area that dilation adds.

    Source: Mip-Splatting, 2-D filter.
    """
    drawn = (before > MIP_EPSILON) & (after > MIP_EPSILON)
    factor = (before / (after + MIP_EPSILON) + MIP_EPSILON).sqrt()
    return torch.where(drawn, factor, 0.0)


def _log_contrast(peaks: Tensor) -> Tensor:
    """Return the logarithm of the ratio of `peaks` to the alpha threshold, at least 0."""
    return (peaks / ALPHA_THRESHOLD).log().clamp(min=0.0)


def _windowed(projection: Projection, opacities: Tensor) -> Shape:
    """Return the shape for Analytic-Splatting, which integrates over the pixel along main axes."""
    middle, half = (projection.xx + projection.yy) / 2, (projection.xx - projection.yy) / 2
    # A round Gaussian has no main axes. Use the axes of the image instead, without a derivative.
    round_ = (half == 0) & (projection.xy == 0)
    half = torch.where(round_, 1.0, half)
    xy = torch.where(round_, 0.0, projection.xy)
    angle = 0.5 * torch.atan2(xy, half)
    spread = torch.where(round_, 0.0, torch.hypot(half, xy))
    larger = middle + spread
    sigma1 = _floored_root(larger)
    sigma2 = _floored_root(projection.det / larger)
    window1, window2 = (_window(torch.zeros_like(s), s) for s in (sigma1, sigma2))
    volume = 2 * pi * sigma1 * sigma2
    reach1 = _window_reach(sigma1, _log_contrast(opacities * volume * window2))
    reach2 = _window_reach(sigma2, _log_contrast(opacities * volume * window1))
    cosine, sine = angle.cos(), angle.sin()
    reach_x = cosine.abs() * reach1 + sine.abs() * reach2
    reach_y = sine.abs() * reach1 + cosine.abs() * reach2
    peaks = opacities * volume * window1 * window2
    radii = (2 * _log_contrast(opacities) * torch.maximum(projection.xx, projection.yy)).sqrt()
    return Shape(
        torch.stack([cosine, sine, sigma1, sigma2], -1),
        opacities,
        peaks,
        torch.stack([reach_x, reach_y], -1),
        radii,
    )


def _floored_root(squares: Tensor) -> Tensor:
    """Return the standard deviations from `squares`; at the lower bound, they have no gradient."""
    return squares.clamp(min=SIGMA_FLOOR**2).sqrt()


def _window(offset: Tensor, sigma: Tensor) -> Tensor:
    """Return the integral of a 1-D Gaussian over a window of one pixel.

    The centre of the window is at distance `offset` from the mean. The integral is F(x + h) - F(x -
    h) with F(x) = sigmoid(LINEAR x + CUBIC x^3), x = offset / sigma and h = 0.5 / sigma. It is
    computed as a product, so that precision is not lost in the tails or for wide Gaussians.
    """
    x = -offset.abs() / sigma
    h = 0.5 / sigma
    upper, lower = _cubic(x + h), _cubic(x - h)
    difference = 2 * h * (LINEAR + CUBIC * (3 * x * x + h * h))
    return -upper.sigmoid() * (-lower).sigmoid() * torch.expm1(-difference)


def _cubic(x: Tensor) -> Tensor:
    return x * (LINEAR + CUBIC * x * x)


def _window_reach(sigma: Tensor, log_contrast: Tensor) -> Tensor:
    """Return the offset beyond which `_window` is below exp(-log_contrast).

    Beyond half a pixel, the window is below sigmoid(-y) < exp(-y), with y = LINEAR t + CUBIC t^3
    and t = (offset - 0.5) / sigma. The cubic equation y(t) = log_contrast has only one real root.
    """
    p = LINEAR / (3 * CUBIC)
    t = 2 * sqrt(p) * torch.sinh(torch.asinh(log_contrast / (2 * CUBIC * p * sqrt(p))) / 3)
    return 0.5 + sigma * t
