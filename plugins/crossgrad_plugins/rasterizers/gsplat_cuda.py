"""gsplat's rasterizer: CUDA; several views of one size are rendered in one call."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    Camera,
    Gaussians,
    Rasterizer,
    Render,
    Response,
    Screen,
    Selection,
    hookimpl,
)
from crossgrad_plugins.rasterizers import _speeds
from crossgrad_plugins.rasterizers.gpu.blended import counter
from crossgrad_plugins.rasterizers.gpu.missing import bring_ninja
from crossgrad_plugins.rasterizers.gpu.nested import Call, Drawing, drawn, empty_render
from crossgrad_plugins.rasterizers.gpu.self_test import self_test
from crossgrad_plugins.rasterizers.reference.harmonics import coefficients_of, view_colors

_GEOMETRY = ("means", "quats", "scales", "opacities")


class GsplatRasterizer(Rasterizer):
    """Renders with the package gsplat (Apache-2).

    docs/rasterizers.md lists the rules in which gsplat differs from crossgrad.

    Source: Ye et al. 2024 (gsplat, arXiv 2409.06765).
    """

    provides: ClassVar[frozenset[str]] = frozenset({"depth", "pixels", "abs_gradient", "count"})
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased"})
    devices: ClassVar[frozenset[str]] = frozenset({"cuda"})
    batched: ClassVar[bool] = True
    deterministic: ClassVar[bool] = False

    max_alpha: float = Field(
        0.999,
        ge=0.999,
        le=0.999,
        description="upper limit of a Gaussian's alpha; gsplat 1.5 supports only this value",
    )

    @classmethod
    @override
    def speed(cls, device: str) -> float:
        return _speeds.gsplat(device)

    @classmethod
    @override
    def missing(cls, device: str) -> str:
        return _speeds.gsplat_missing() if device in cls.devices else ""

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return an objection if the package or its compiler is missing."""
        missing = self.missing(selection.device)
        return [f"{missing}, or leave --rasterizer out"] if missing else []

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
        return self.render_views([(gaussians, camera)], [background], outputs)[0]

    @override
    def render_views(
        self,
        views: Sequence[tuple[Gaussians, Camera]],
        backgrounds: Sequence[Tensor],
        outputs: frozenset[str] = frozenset(),
    ) -> list[Render]:
        alike: dict[tuple[object, ...], list[int]] = defaultdict(list)
        for slot, (gaussians, camera) in enumerate(views):
            size = (camera.width, camera.height, len(gaussians))
            alike[*size, gaussians.dilation, gaussians.response].append(slot)
        renders: dict[int, Render] = {}
        for slots in alike.values():
            group, behind = [views[s] for s in slots], [backgrounds[s] for s in slots]
            renders.update(zip(slots, self._drawn(group, behind, outputs), strict=True))
        return [renders[slot] for slot in range(len(views))]

    def _drawn(
        self,
        views: Sequence[tuple[Gaussians, Camera]],
        backgrounds: Sequence[Tensor],
        outputs: frozenset[str],
    ) -> list[Render]:
        """Return the renders of K views of one size with N Gaussians each, in one call."""
        gaussians, camera = views[0]
        if not len(gaussians):
            return [
                empty_render(view_gaussians, view_camera, behind, outputs)
                for (view_gaussians, view_camera), behind in zip(views, backgrounds, strict=True)
            ]
        bring_ninja()
        screens = [
            Screen(
                torch.zeros(
                    len(view_gaussians), dtype=torch.int32, device=view_gaussians.means.device
                )
            )
            for view_gaussians, _ in views
        ]
        # Each view gets a separate batch of Gaussians, so that the gradients of the views stay
        # separate.
        tensors = [
            _batch([getattr(view_gaussians, name) for view_gaussians, _ in views])
            for name in _GEOMETRY
        ]
        tensors.append(_batch([_colors(view_gaussians, c) for view_gaussians, c in views]))
        settings = {
            "width": camera.width,
            "height": camera.height,
            "near_plane": self.near,
            "eps2d": self.dilation if gaussians.dilation is None else gaussians.dilation,
            "packed": False,
            "backgrounds": _batch(backgrounds)[:, None],
            "render_mode": "RGB+D" if "depth" in outputs else "RGB",
            "absgrad": "abs_gradient" in outputs,
            "rasterize_mode": "antialiased" if gaussians.response == "antialiased" else "classic",
            **_cameras([camera for _, camera in views], gaussians.means),
        }
        call = Call(partial(_draw, screens, settings, outputs), partial(_observe, screens))
        channels, alpha = drawn(call, tensors)
        return [
            Render(
                image=channels[view, ..., :3],
                alpha=alpha[view, ..., 0],
                screen=screen,
                depth=channels[view, ..., 3] if "depth" in outputs else None,
            )
            for view, screen in enumerate(screens)
        ]


def _batch(tensors: Sequence[Tensor]) -> Tensor:
    """Return a batch [K, ...] of K tensors; a single tensor is not copied."""
    return tensors[0][None] if len(tensors) == 1 else torch.stack(list(tensors))


def _colors(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return [N, 3] RGB like `view_colors`, but evaluate SH above degree 0 in one kernel."""
    center = camera.center.to(gaussians.means, non_blocking=True)
    coefficients = coefficients_of(gaussians) if gaussians.colors is None else None
    if coefficients is None or not gaussians.sh_degree:
        return view_colors(gaussians, center)
    from gsplat import spherical_harmonics

    harmonics: Tensor = spherical_harmonics(
        gaussians.sh_degree, gaussians.means - center, coefficients
    )
    return (0.5 + harmonics).clamp(min=0.0)


def _cameras(cameras: Sequence[Camera], like: Tensor) -> dict[str, Tensor]:
    """Return poses [K, 1, 4, 4] and intrinsics [K, 1, 3, 3], copied together to the device."""
    poses = torch.stack([camera.world_to_camera.reshape(-1) for camera in cameras])
    matrices = torch.stack([camera.matrix.reshape(-1) for camera in cameras])
    both = torch.cat([poses, matrices], 1).to(like, non_blocking=True)
    count = len(cameras)
    return {"viewmats": both[:, :16].view(count, 1, 4, 4), "Ks": both[:, 16:].view(count, 1, 3, 3)}


def _draw(
    screens: Sequence[Screen],
    settings: Mapping[str, Any],
    outputs: frozenset[str],
    tensors: Sequence[Tensor],
) -> Drawing:
    from gsplat import rasterization

    means, quats, scales, opacities, colors = tensors
    channels, alpha, meta = rasterization(means, quats, scales, opacities, colors, **settings)
    for view, screen in enumerate(screens):
        screen.radii = meta["radii"][view, 0].amax(-1)
        if "count" in outputs:
            screen.count = counter(meta, view)
        if "pixels" in outputs:
            everywhere = torch.ones_like(alpha[view, 0, ..., 0], dtype=torch.bool)
            screen.pixels = counter(meta, view)(everywhere)
    return Drawing((channels[:, 0], alpha[:, 0]), meta["means2d"])


def _observe(screens: Sequence[Screen], centers: Tensor, gradient: Tensor) -> None:
    """Store the gradients [K, 1, N, 2] with respect to the projected means."""
    absolute = getattr(centers, "absgrad", None)
    for view, screen in enumerate(screens):
        screen.mean_gradient = gradient[view, 0]
        if absolute is not None:
            screen.abs_gradient = absolute[view, 0]
