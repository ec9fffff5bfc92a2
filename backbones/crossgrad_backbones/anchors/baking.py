"""Neural Gaussians as plain ones: what the cameras that see an anchor see of it, on average."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from crossgrad_backbones.anchors.activation import Seen
from crossgrad_backbones.anchors.heads import COVARIANCE, Heads
from crossgrad_core.gaussians import Gaussians
from crossgrad_core.rasterizer import ALPHA_THRESHOLD
from crossgrad_core.scene.types import Camera
from crossgrad_core.spherical import SH_C0

#: The average is taken over at most so many cameras.
BAKED_CAMERAS = 32


def evenly(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of the cameras, evenly spread over their order."""
    count = min(len(cameras), most)
    return [cameras[i * len(cameras) // count] for i in range(count)]


@dataclass
class _Sums:
    """Sums over cameras, for all P anchors and k slots.

    Attributes:
        cameras: [P, 1] cameras that counted.
        opacities: [P, k].
        looks: [P, k, 10] scales, quaternion and colour, each times the opacity.
    """

    cameras: Tensor
    opacities: Tensor
    looks: Tensor

    @classmethod
    def zeros(cls, anchors: int, slots: int, like: Tensor) -> "_Sums":
        return cls(
            like.new_zeros(anchors, 1),
            like.new_zeros(anchors, slots),
            like.new_zeros(anchors, slots, COVARIANCE + 3),
        )

    def add(self, rows: Tensor, opacities: Tensor, looks: Tensor) -> None:
        """Adds what one camera sees of anchors `rows`."""
        sums = self.looks[rows]
        # A quaternion and its negative are the same rotation.
        along = (sums[..., 3:7] * looks[..., 3:7]).sum(-1, keepdim=True)
        looks[..., 3:7] *= torch.where(along < 0, -1.0, 1.0)
        self.looks[rows] = sums + opacities[..., None] * looks
        self.opacities[rows] += opacities
        self.cameras[rows] += 1.0


@torch.no_grad()
def baked(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    views: Sequence[tuple[Camera, Seen]],
    code: Tensor | None = None,
) -> Gaussians:
    """Plain Gaussians, for every anchor the mean over the cameras that see it.

    Opacities are averaged with 0 for cameras that do not draw a Gaussian; scales, rotations and
    colours are averaged with the opacities as weights. An anchor that no camera sees is taken as
    all of them would see it.

    Args:
        heads: The networks.
        parameters: As for `decoded`.
        views: Cameras, and what each sees.
        code: [C] appearance code, or None.

    Returns:
        Gaussians with `sh_dc` that are drawn somewhere, anchor by anchor.
    """
    offsets = parameters["offsets"]
    anchors, slots = offsets.shape[:2]
    sums = _Sums.zeros(anchors, slots, offsets)
    for camera, seen in views:
        sums.add(seen.rows, *_looks(heads, parameters, camera, seen, code))
    unseen = Seen((sums.cameras[:, 0] == 0).nonzero().squeeze(1))
    for camera, _ in views if len(unseen.rows) else ():
        sums.add(unseen.rows, *_looks(heads, parameters, camera, unseen, code))
    return _drawn(parameters, sums)


def _looks(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    camera: Camera,
    seen: Seen,
    code: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Opacities [A, k], 0 where nothing is drawn, and scales, unit quaternions, colours."""
    positions = parameters["anchors"][seen.rows]
    features = parameters["features"][seen.rows]
    views = heads.views(positions - camera.center.to(positions))
    raw = heads.raw(parameters, features, views, code)
    opacities = torch.tanh(raw.opacities).clamp(min=0.0)
    if seen.factor is not None:
        opacities *= seen.factor[:, None]
    slots = heads.offsets
    covariances = raw.covariances.view(-1, slots, COVARIANCE)
    sizes = torch.exp(parameters["scales"][seen.rows, 3:])[:, None, :]
    scales = sizes * torch.sigmoid(covariances[..., :3])
    colors = torch.sigmoid(raw.colors.view(-1, slots, 3))
    return opacities, torch.cat([scales, normalize(covariances[..., 3:], dim=-1), colors], -1)


def _drawn(parameters: Mapping[str, Tensor], sums: _Sums) -> Gaussians:
    opacities = sums.opacities / sums.cameras
    anchor, slot = (opacities >= ALPHA_THRESHOLD).nonzero().unbind(1)
    looks = sums.looks[anchor, slot] / sums.opacities[anchor, slot][:, None]
    stretch = torch.exp(parameters["scales"][anchor, :3])
    return Gaussians(
        means=parameters["anchors"][anchor] + parameters["offsets"][anchor, slot] * stretch,
        quats=normalize(looks[:, 3:7], dim=-1),
        scales=looks[:, :3],
        opacities=opacities[anchor, slot],
        sh_dc=((looks[:, 7:] - 0.5) / SH_C0)[:, None, :],
    )
