"""Convert neural Gaussians to plain Gaussians by averaging over cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi, sqrt

import torch
from torch import Tensor
from torch.nn.functional import normalize

from crossgrad_backbones.anchors.heads import COVARIANCE, Heads, Seen
from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, SH_C0
from crossgrad_core.plugin import Camera, Gaussians

#: Factor of the spherical harmonics of degree 1: sqrt(3 / (4 pi)).
_SH_C1 = sqrt(3.0 / (4.0 * pi))
#: Regularization of the coefficients of degree 1, relative to their weight if directions come from
#: all sides. If all directions are equal, the regularization keeps these coefficients at 0.
RIDGE = 0.01
_BASIS = 4


@dataclass(frozen=True, eq=False)
class ColorFit:
    """Normal equations of a least-squares fit of colours, for P anchors with k slots each.

    Attributes:
        products: [P, k, 4, 4] weighted sums of products of two basis functions.
        colors: [P, k, 4, 3] weighted sums of basis functions times (colour - 1/2).
    """

    products: Tensor
    colors: Tensor

    @classmethod
    def zeros(cls, like: Tensor) -> "ColorFit":
        """Create sums of zero for tensors [P, k, ...]."""
        shape = (*like.shape[:2], _BASIS)
        return cls(like.new_zeros(*shape, _BASIS), like.new_zeros(*shape, 3))

    def add(self, rows: Tensor, weights: Tensor, directions: Tensor, colors: Tensor) -> None:
        """Add the colours of the anchors `rows` [A], seen along `directions`.

        Args:
            rows: [A] int64 rows of the anchors, without duplicates.
            weights: [A, k] weights of the colours.
            directions: [A, k, 3] unit vectors from the camera to the Gaussians.
            colors: [A, k, 3] RGB colours.
        """
        x, y, z = directions.unbind(-1)
        ones = torch.full_like(x, SH_C0)
        basis = torch.stack([ones, -_SH_C1 * y, _SH_C1 * z, -_SH_C1 * x], -1)
        weighted = weights[..., None, None] * basis[..., None]
        self.products[rows] += weighted * basis[..., None, :]
        self.colors[rows] += weighted * (colors[..., None, :] - 0.5)

    def solved(self, anchor: Tensor, slot: Tensor) -> Tensor:
        """Return the colour coefficients [G, 4, 3] of G slots.

        The coefficients belong to four basis functions and three channels.

        Each slot needs at least one weight that is not 0.
        """
        products = self.products[anchor, slot]
        total = products[:, 0, 0] / SH_C0**2
        ridge = torch.diag(products.new_tensor([0.0, 1.0, 1.0, 1.0]))
        full = products + (RIDGE * _SH_C1**2 / 3.0) * total[:, None, None] * ridge
        solution: Tensor = torch.linalg.solve(full, self.colors[anchor, slot])
        return solution


#: Averages are computed over at most this number of cameras.
BAKED_CAMERAS = 32


def evenly(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """Return at most `most` of the cameras, evenly spaced."""
    count = min(len(cameras), most)
    return [cameras[i * len(cameras) // count] for i in range(count)]


@dataclass(frozen=True, eq=False)
class Look:
    """The appearance of A anchors with k slots each in one camera.

    Attributes:
        opacities: [A, k] opacities; 0 for slots that are not rendered.
        covariances: [A, k, 7] scales and unit quaternions.
        colors: [A, k, 3] RGB colours.
        directions: [A, k, 3] unit vectors from the camera to the Gaussians' centres.
    """

    opacities: Tensor
    covariances: Tensor
    colors: Tensor
    directions: Tensor


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over cameras, for all P anchors with k slots each.

    Attributes:
        cameras: [P, 1] number of cameras that were added for each anchor.
        opacities: [P, k] sums of the opacities.
        covariances: [P, k, 7] sums of scales and quaternions, weighted by the opacities.
        colors: Fit of the colours by direction, weighted by the opacities.
    """

    cameras: Tensor
    opacities: Tensor
    covariances: Tensor
    colors: ColorFit

    @classmethod
    def zeros(cls, offsets: Tensor) -> "_Sums":
        """Create sums of zero for offsets [P, k, 3]."""
        shape = offsets.shape[:2]
        return cls(
            offsets.new_zeros(shape[0], 1),
            offsets.new_zeros(shape),
            offsets.new_zeros(*shape, COVARIANCE),
            ColorFit.zeros(offsets),
        )

    def add(self, rows: Tensor, look: Look) -> None:
        """Add the appearance of the anchors `rows` in one camera."""
        sums = self.covariances[rows]
        # A quaternion and its negative describe the same rotation. Choose the sign that matches the
        # sum so far.
        along = (sums[..., 3:] * look.covariances[..., 3:]).sum(-1, keepdim=True)
        look.covariances[..., 3:] *= torch.where(along < 0, -1.0, 1.0)
        self.covariances[rows] = sums + look.opacities[..., None] * look.covariances
        self.opacities[rows] += look.opacities
        self.cameras[rows] += 1.0
        self.colors.add(rows, look.opacities, look.directions, look.colors)


@torch.no_grad()
def baked(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    views: Sequence[tuple[Camera, Seen]],
    code: Tensor | None = None,
) -> Gaussians:
    """Convert anchors to plain Gaussians.

    The values of an anchor are averaged over the cameras that see the anchor. In the average of
    opacities, a camera that does not render a Gaussian counts with 0. Scales, rotations and colours
    are averaged with the opacities as weights. Colours use spherical harmonics of degree 0 and 1.
    The values of an anchor that no camera sees are averaged over all cameras.

    Args:
        heads: The networks of the anchors.
        parameters: The parameters, as described in `decoded`.
        views: Cameras, each with the anchors that the camera sees.
        code: [C] appearance code; None without codes.

    Returns:
        Gaussians of degree 1, in the order of their anchors. Gaussians whose mean opacity is below
        the alpha threshold are left out.
    """
    sums = _Sums.zeros(parameters["offsets"])
    for camera, seen in views:
        sums.add(seen.rows, _look(heads, parameters, camera, seen, code))
    unseen = Seen((sums.cameras[:, 0] == 0).nonzero().squeeze(1))
    for camera, _ in views if len(unseen.rows) else ():
        sums.add(unseen.rows, _look(heads, parameters, camera, unseen, code))
    return _drawn(parameters, sums)


def _look(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    camera: Camera,
    seen: Seen,
    code: Tensor | None,
) -> Look:
    anchors, offsets, features, log_scales = (
        parameters[name][seen.rows] for name in ("anchors", "offsets", "features", "scales")
    )
    eye = camera.center.to(anchors, non_blocking=True)
    raw = heads.raw(parameters, features, heads.views(anchors - eye), code)
    opacities = torch.tanh(raw.opacities).clamp(min=0.0)
    if seen.factor is not None:
        opacities *= seen.factor[:, None]
    covariances = raw.covariances.view(-1, heads.offsets, COVARIANCE)
    stretch, size = torch.split(torch.exp(log_scales)[:, None, :], 3, -1)
    scales = size * sigmoid(covariances[..., :3])
    return Look(
        opacities,
        torch.cat([scales, normalize(covariances[..., 3:], dim=-1)], -1),
        sigmoid(raw.colors.view(-1, heads.offsets, 3)),
        normalize(anchors[:, None] + offsets * stretch - eye, dim=-1),
    )


def _drawn(parameters: Mapping[str, Tensor], sums: _Sums) -> Gaussians:
    opacities = sums.opacities / sums.cameras
    anchor, slot = (opacities >= ALPHA_THRESHOLD).nonzero().unbind(1)
    covariances = sums.covariances[anchor, slot] / sums.opacities[anchor, slot][:, None]
    stretch = torch.exp(parameters["scales"][anchor, :3])
    harmonics = sums.colors.solved(anchor, slot)
    return Gaussians(
        means=parameters["anchors"][anchor] + parameters["offsets"][anchor, slot] * stretch,
        quats=normalize(covariances[:, 3:], dim=-1),
        scales=covariances[:, :3],
        opacities=opacities[anchor, slot],
        sh_dc=harmonics[:, :1],
        sh_rest=harmonics[:, 1:],
        sh_degree=1,
    )
