"""Base class of anchor backbones: options, blocks, initial values, decoding, regularization."""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors import options
from crossgrad_backbones.anchors.baking import BAKED_CAMERAS, baked, evenly
from crossgrad_backbones.anchors.decode import decoded
from crossgrad_backbones.anchors.heads import Seen
from crossgrad_backbones.anchors.options import AnchorOptions
from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, JACOBIAN_MARGIN
from crossgrad_core.plugin import (
    Camera,
    Gaussians,
    Parameters,
    Phase,
    RegularizeContext,
    RegularizeResult,
    Scene,
    UserError,
    hookimpl,
)

#: Near plane, and dilation in px^2, of the frustum filter. The near plane and the dilation equal
#: the defaults of the rasterizers.
NEAR, DILATION = 1e-3, 0.3
#: At this number of standard deviations from its centre, the alpha of an opaque Gaussian equals the
#: alpha threshold.
REACH = math.sqrt(-2.0 * math.log(ALPHA_THRESHOLD))
#: Distance of the outermost pixel centres from the image border, in pixels.
_HALF_PIXEL = 0.5


@torch.no_grad()
def in_frustum(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    """Return a mask [P] of the anchors whose own Gaussian would be visible in the image.

    Each anchor is treated as an opaque, unrotated Gaussian. The scales of this Gaussian are the
    scales of the anchor's offsets. The Gaussian of an anchor is projected with the formulas of the
    rasterizers. An anchor is in the frustum if the bounding box of the footprint (alpha >= 1/255)
    contains a pixel centre.

    Args:
        positions: [P, 3] positions in local units.
        log_scales: [P, 3] or more columns of log scales; the first three columns are used.
        camera: The camera of the image.

    Source: Scaffold-GS, section 3.2 (view-frustum filtering).
    """
    tensors = (positions, log_scales)
    if all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors):
        return _fused(positions, log_scales, camera)
    return _plain(positions, log_scales, camera)


def _axes(camera: Camera) -> list[tuple[float, ...]]:
    """Return six values for x and six for y.

    The six values are focal length, principal point, two slope limits, and first and last pixel
    centre.
    """
    sizes = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    axes: list[tuple[float, ...]] = []
    for focal, center, size in sizes:
        margin = JACOBIAN_MARGIN * size / (2.0 * focal)
        slopes = (-center / focal - margin, (size - center) / focal + margin)
        axes.append((focal, center, *slopes, _HALF_PIXEL, size - _HALF_PIXEL))
    return axes


def _plain(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    pose = camera.world_to_camera.to(positions, non_blocking=True)
    *flat, depth = torch.addmm(pose[:3, 3], positions, pose[:3, :3].T).unbind(1)
    squares = torch.exp(2.0 * log_scales[:, :3])
    inside = depth > NEAR
    for along, axis, (focal, center, least, most, first, last) in zip(
        flat, pose, _axes(camera), strict=False
    ):
        slope = along / depth
        # Row of the Jacobian in world axes, multiplied by depth / focal.
        row = axis[:3] - slope.clamp(least, most)[:, None] * pose[2, :3]
        variance = (row.square() * squares).sum(1) * (focal / depth).square() + DILATION
        extent = REACH * variance.sqrt()
        projected = focal * slope + center
        inside &= (projected + extent >= first) & (projected - extent <= last)
    return inside


def _fused(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    from crossgrad_backbones.anchors.numba_kernels import frustum
    from crossgrad_core.numerics.jobs import parallel

    inside = np.empty(len(positions), np.bool_)
    parallel(
        frustum.in_frustum,
        positions.detach().contiguous().numpy(),
        log_scales.detach().contiguous().numpy(),
        camera.world_to_camera[:3].float().numpy(),
        np.array(_axes(camera), np.float32),
        np.float32(NEAR),
        np.float32(DILATION),
        np.float32(REACH),
        inside,
    )
    return torch.from_numpy(inside)


def mean_volume(gaussians: Gaussians) -> Tensor:
    """Return the mean volume of the Gaussians (the product of their scales); 0 without Gaussians.

    Source: Scaffold-GS, section 3.4.
    """
    return gaussians.scales.prod(1).sum() / max(1, len(gaussians))


@dataclass(frozen=True)
class Used:
    """The anchors that a camera uses, and the factors of their opacities.

    Attributes:
        mask: [P] bool, True for anchors that the camera uses.
        factor: [P] factor of each anchor's opacities, in [0, 1]; None if all factors are 1.
    """

    mask: Tensor
    factor: Tensor | None = None


class AnchorBackbone(AnchorOptions):
    """Anchors with one feature vector each.

    Networks decode k Gaussians from each anchor for each view.

    A subclass decides where the initial anchors are, and which anchors a camera uses.

    Blocks: `anchors` [P, 3], frozen; `offsets` [P, k, 3] in units of exp(scales[:, :3]); `features`
    [P, F]; `scales` [P, 6], logarithms of three scales of the offsets and three sizes of Gaussians;
    `mlp_opacity`, `mlp_cov`, `mlp_color` and, if enabled, `mlp_bank`, with four tensors each;
    `voxel_size`, frozen. The published code also stores a rotation and an opacity for each anchor,
    but never trains these two tensors. crossgrad leaves out the rotations and opacities of anchors.
    Source: Scaffold-GS (Lu et al. 2024).
    """

    positions: ClassVar[str] = "anchors"

    def created(
        self,
        positions: NDArray[np.float64],
        spacing: NDArray[np.float64],
        voxel_size: float,
        scene: Scene,
        rng: np.random.Generator,
    ) -> Parameters:
        """Create the initial values of all blocks that this class defines.

        Args:
            positions: [P, 3] positions of the anchors in local units.
            spacing: [P] initial sizes of the anchors in local units.
            voxel_size: Edge of the smallest voxel in local units.
            scene: The scene, whose training views get appearance codes.
            rng: Random generator for the initial values of networks and codes.
        """
        count = positions.shape[0]
        scales = torch.from_numpy(np.log(spacing)).float()
        tensors: Parameters = {
            "anchors": torch.from_numpy(positions).float(),
            "offsets": torch.zeros(count, self.offsets, 3),
            "features": torch.zeros(count, self.feature),
            "scales": scales[:, None].repeat(1, 6),
            "voxel_size": torch.tensor(voxel_size, dtype=torch.float64),
        }
        for network in self.heads.networks:
            tensors |= network.created(rng)
        if self.appearance:
            codes = rng.standard_normal((len(scene.train), self.appearance)).astype(np.float32)
            tensors |= options.created_codes(scene, torch.from_numpy(codes))
        trained = {name for block in self.trained_blocks() for name in block.tensors}
        return {name: tensor.requires_grad_(name in trained) for name, tensor in tensors.items()}

    @override
    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Create anchors at the means of Gaussians. Other properties of the Gaussians are not used.

        Raises:
            UserError: The opacities of all Gaussians are below the alpha threshold.
        """
        drawn = gaussians.opacities >= ALPHA_THRESHOLD
        if not bool(drawn.any()):
            raise UserError(
                "no Gaussian is opaque enough to become an anchor",
                where="--init",
                expected=f"Gaussians with opacities of at least {ALPHA_THRESHOLD:.4f}",
                found=f"{len(drawn)} Gaussians, all of them fainter",
                todo="use another file, --init points or --init random",
            )
        points = gaussians.means[drawn].double().numpy()
        colors = np.full(points.shape, 127, dtype=np.uint8)
        return self.create(replace(scene, points=points, point_colors=colors), rng)

    @abstractmethod
    def used(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Used | None:
        """Return the anchors that a camera uses, without a test of its frustum.

        If the result is None, the camera uses all anchors.

        Args:
            parameters: The parameters.
            camera: The camera.
            phase: The phase of training or evaluation.
        """

    def seen(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Seen:
        """Return the anchors that a camera uses and that are inside its frustum."""
        mask = in_frustum(parameters["anchors"], parameters["scales"].detach(), camera)
        used = self.used(parameters, camera, phase)
        if used is None:
            return Seen(mask.nonzero().squeeze(1))
        rows = (mask & used.mask).nonzero().squeeze(1)
        return Seen(rows, None if used.factor is None else used.factor[rows])

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        seen = self.seen(parameters, camera, phase)
        code = self._code(parameters, camera, training=phase.training)
        return decoded(self.heads, parameters, camera, seen, code)

    def _code(
        self, parameters: Mapping[str, Tensor], camera: Camera, *, training: bool
    ) -> Tensor | None:
        if not self.appearance:
            return None
        codes, poses = parameters[options.CODES], parameters[options.POSES]
        return options.code_of(codes, poses, camera, training=training)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        chosen = evenly(cameras, BAKED_CAMERAS)
        views = [(camera, self.seen(parameters, camera, phase)) for camera in chosen]
        code = self._code(parameters, cameras[0], training=False)
        return baked(self.heads, parameters, views, code)

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> RegularizeResult | None:
        """Return the mean volume of the Gaussians of a view, multiplied by `volume_weight`."""
        if context.gaussians is None or not self.volume_weight:
            return None
        return RegularizeResult(self.volume_weight * mean_volume(context.gaussians))
