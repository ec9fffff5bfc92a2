"""gswarp's rasterizer, which uses NVIDIA Warp.

Warp contains a compiler, so only a GPU driver is required.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from crossgrad_core.plugin import (
    Camera,
    Gaussians,
    Rasterizer,
    Render,
    Screen,
    Selection,
    hookimpl,
)
from crossgrad_plugins.rasterizers import _speeds
from crossgrad_plugins.rasterizers.gpu.nested import Call, Drawing, drawn, empty_render
from crossgrad_plugins.rasterizers.gpu.self_test import self_test
from crossgrad_plugins.rasterizers.reference.harmonics import coefficients_of, view_colors

#: gswarp omits Gaussians that are nearer than this depth, in the units of its input.
_NEAR = 0.2


class GswarpRasterizer(Rasterizer):
    """Renders with the package gswarp (Apache-2).

    docs/rasterizers.md lists the rules in which gswarp differs from crossgrad. The near plane of
    gswarp cannot be changed. Therefore the scene is scaled so that this plane is at the depth
    `near`.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"depth"})
    devices: ClassVar[frozenset[str]] = frozenset({"cuda"})
    deterministic: ClassVar[bool] = False

    max_alpha: float = Field(
        0.99,
        ge=0.99,
        le=0.99,
        description="upper limit of a Gaussian's alpha; gswarp supports only this value",
    )
    dilation: float = Field(
        0.3,
        ge=0.3,
        le=0.3,
        description="dilation of the 2-D covariance, px^2; gswarp supports only this value",
    )
    footprint: Literal["3-sigma"] = Field(
        "3-sigma",
        description="size of the rendered footprint, as in the original code; gswarp supports "
        "only this value",
    )

    @classmethod
    @override
    def speed(cls, device: str) -> float:
        return _speeds.gswarp(device)

    @classmethod
    @override
    def missing(cls, device: str) -> str:
        return _speeds.gswarp_missing() if device in cls.devices else ""

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return objections if a package is missing or gswarp does not support the selection."""
        if selection.device not in self.devices:
            return []
        reasons = []
        if missing := self.missing(selection.device):
            reasons.append(f"{missing}, or leave --rasterizer out")
        if selection.backbone.sets_dilation and selection.backbone.response in self.responses:
            name = selection.names["backbone"]
            reasons.append(
                f"rasterizer gswarp always dilates by 0.3 px^2, but backbone {name} sets its "
                "own dilation"
            )
        if selection.resolution.strided:
            name = selection.names["resolution"]
            reasons.append(
                f"rasterizer gswarp always dilates by 0.3 px^2, but resolution {name} needs less"
            )
        return reasons

    @override
    def self_test(self, device: str) -> None:
        self_test(self, device)

    @override
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        if not len(gaussians):
            return empty_render(gaussians, camera, background, outputs)
        device = gaussians.means.device
        screen = Screen(torch.zeros(len(gaussians), dtype=torch.int32, device=device))
        enlarged = _NEAR / self.near
        size = (camera.width / 2, camera.height / 2)
        degree = gaussians.sh_degree if gaussians.colors is None else 0
        call = Call(
            partial(_draw, screen, settings_of(camera, background, enlarged, degree)),
            partial(_observe, screen, size),
        )
        tensors = [
            gaussians.means * enlarged,
            normalize(gaussians.quats, dim=-1),
            gaussians.scales * enlarged,
            gaussians.opacities[:, None],
            _colors(gaussians, camera, degree),
        ]
        image, alpha, depth = drawn(call, tensors)
        return Render(
            image=image.permute(1, 2, 0),
            alpha=alpha[0],
            screen=screen,
            depth=depth[0] / enlarged if "depth" in outputs else None,
        )


def _colors(gaussians: Gaussians, camera: Camera, degree: int) -> Tensor:
    """Return [N, 3] RGB, or [N, (degree + 1)^2, 3] SH coefficients for gswarp's kernel."""
    coefficients = coefficients_of(gaussians) if degree else None
    if coefficients is not None:
        return coefficients
    return view_colors(gaussians, camera.center.to(gaussians.means, non_blocking=True))


def settings_of(camera: Camera, background: Tensor, enlarged: float, degree: int) -> dict[str, Any]:
    """Return gswarp's settings for a camera of a scene that is scaled by a factor.

    Above degree 0, gswarp itself evaluates spherical harmonics. gswarp expects transposed matrices.
    The projection maps the image to [-1, 1] and includes the principal point.
    """
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= enlarged
    width, height = camera.width, camera.height
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[0, 2] = 2 * camera.fx / width, 2 * camera.cx / width - 1
    projection[1, 1], projection[1, 2] = 2 * camera.fy / height, 2 * camera.cy / height - 1
    projection[2, 2] = projection[3, 2] = 1.0
    matrices = torch.stack([pose.T, (projection @ pose).T]).to(background, non_blocking=True)
    return {
        "image_height": height,
        "image_width": width,
        "tanfovx": width / (2 * camera.fx),
        "tanfovy": height / (2 * camera.fy),
        "bg": background,
        "scale_modifier": 1.0,
        "viewmatrix": matrices[0],
        "projmatrix": matrices[1],
        "sh_degree": degree,
        "campos": (camera.center * enlarged).to(background, non_blocking=True),
        "prefiltered": False,
        "auto_tune_verbose": False,
    }


def _draw(screen: Screen, settings: dict[str, Any], tensors: Sequence[Tensor]) -> Drawing:
    from gswarp import GaussianRasterizationSettings, GaussianRasterizer

    means, quats, scales, opacities, colors = tensors
    centers = torch.zeros_like(means).requires_grad_()
    image, screen.radii, meta = GaussianRasterizer(GaussianRasterizationSettings(**settings))(
        means3D=means,
        means2D=centers,
        opacities=opacities,
        **{"shs" if settings["sh_degree"] else "colors_precomp": colors},
        scales=scales,
        rotations=quats,
    )
    return Drawing((image, meta.alpha, meta.depth), centers)


def _observe(screen: Screen, half: tuple[float, float], _centers: Tensor, gradient: Tensor) -> None:
    """Store the gradient [N, 3] with respect to the projected means.

    The gradient is converted from NDC units to pixels.
    """
    along = zip(gradient[:, :2].unbind(1), half, strict=True)
    screen.mean_gradient = torch.stack([component / side for component, side in along], dim=1)
