"""The CPU rasterizer: it renders tile by tile, with a hand-written backward pass.

The results have the same bits for any number of cores.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
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
    UserError,
)
from crossgrad_plugins.rasterizers import _speeds
from crossgrad_plugins.rasterizers.footprint import DESCRIPTION, Footprint
from crossgrad_plugins.rasterizers.numba_kernels.arrays import (
    CameraArrays,
    DrawOptions,
    Frame,
    GaussianArrays,
)
from crossgrad_plugins.rasterizers.numba_kernels.frame import backward, forward, marked_pixels

#: The differentiable inputs, in the order of autograd's arguments.
_INPUTS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


class NumbaRasterizer(Rasterizer):
    """Renders float32 Gaussians on the CPU.

    Kernels are compiled once and cached on disk.
    """

    provides: ClassVar[frozenset[str]] = frozenset(
        {"depth", "pixels", "abs_gradient", "directions", "count"}
    )
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased", "analytic"})
    sparse_rows: ClassVar[bool] = True

    footprint: Footprint = Field("alpha", description=DESCRIPTION)

    @classmethod
    @override
    def speed(cls, device: str) -> float:
        return _speeds.numba(device)

    @override
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        options = DrawOptions(
            max_alpha=self.max_alpha,
            near=self.near,
            dilation=self.dilation if gaussians.dilation is None else gaussians.dilation,
            response=gaussians.response,
            squares=self.footprint == "3-sigma",
            depth="depth" in outputs,
            pixels="pixels" in outputs,
        )
        screen = Screen(radii=torch.empty(0, dtype=torch.int32))
        _require_fitting(gaussians)
        call = _Call(_arrays(gaussians), camera, background, options, screen, outputs)
        tensors = [getattr(gaussians, name) for name in _INPUTS]
        image, alpha, depth = _Draw.apply(call, *tensors)  # type: ignore[no-untyped-call]
        return Render(image, alpha, screen, depth)


class _Call:
    """The values besides tensors that autograd must pass to the backward pass."""

    def __init__(
        self,
        gaussians: GaussianArrays,
        camera: Camera,
        background: Tensor,
        options: DrawOptions,
        screen: Screen,
        outputs: frozenset[str],
    ) -> None:
        self.gaussians = gaussians
        self.camera = camera
        self.background = background
        self.options = options
        self.screen = screen
        self.absolute = "abs_gradient" in outputs
        self.directions = "directions" in outputs
        self.counts = "count" in outputs
        self.frame: Frame | None = None


def _require_fitting(gaussians: Gaussians) -> None:
    """Raise an error for inconsistent shapes, because the kernels do not check bounds."""
    if misfit := gaussians.misfit():
        raise UserError(
            "the Gaussians of the backbone cannot be rendered",
            where="the result of the backbone's `decode`",
            expected="tensors with one row for each Gaussian (crossgrad_core.plugin.Gaussians)",
            found=misfit,
            todo="repair `decode` of the backbone; `crossgrad plugins check` tests it",
        )


def _array(tensor: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


def _optional(tensor: Tensor | None) -> NDArray[np.float32] | None:
    return None if tensor is None else _array(tensor)


def _arrays(gaussians: Gaussians) -> GaussianArrays:
    rest = _optional(gaussians.sh_rest)
    if gaussians.sh_dc is not None and rest is None:
        rest = np.empty((len(gaussians), 0, 3), np.float32)
    demand = gaussians.on_demand
    return GaussianArrays(
        means=_array(gaussians.means),
        quats=_array(gaussians.quats),
        scales=_array(gaussians.scales),
        opacities=_array(gaussians.opacities),
        colors=_optional(gaussians.colors),
        dc=_optional(gaussians.sh_dc),
        rest=rest,
        degree=gaussians.sh_degree,
        sparse_rows=frozenset() if demand is None else demand.fields,
        bring=None if demand is None else lambda rows: demand.bring(torch.from_numpy(rows)),
    )


def _counter(frame: Frame) -> Callable[[Tensor], Tensor]:
    """Return the function for `Screen.count`, without keeping the frame's images in memory."""
    drawn = frame.projected, frame.lists, frame.masks, frame.options

    def count(marked: Tensor) -> Tensor:
        return torch.from_numpy(marked_pixels(*drawn, marked.contiguous().numpy().view(np.uint8)))

    return count


class _Draw(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, call: _Call, *tensors: Tensor | None) -> Any:
        camera = call.camera
        frame = forward(
            call.gaussians,
            CameraArrays(
                camera.world_to_camera.numpy(),
                camera.matrix.numpy(),
                camera.width,
                camera.height,
            ),
            _array(call.background),
            call.options,
        )
        call.frame = frame
        call.screen.radii = torch.from_numpy(frame.projected.radii)
        if frame.projected.rows is not None:
            call.screen.rows = torch.from_numpy(frame.projected.rows.astype(np.int64))
        call.screen.pixels = None if frame.pixels is None else torch.from_numpy(frame.pixels)
        if call.counts:
            call.screen.count = _counter(frame)
        ctx.call = call
        ctx.set_materialize_grads(False)
        depth = None if frame.depth is None else torch.from_numpy(frame.depth)
        return torch.from_numpy(frame.image), torch.from_numpy(frame.alpha), depth

    @staticmethod
    @override
    def backward(
        ctx: Any, v_image: Tensor | None, v_alpha: Tensor | None, v_depth: Tensor | None
    ) -> Any:
        call: _Call = ctx.call
        frame = call.frame
        if frame is None:
            raise RuntimeError("the backward pass was called before the forward pass")
        v = np.zeros_like(frame.image) if v_image is None else _array(v_image)
        gradients = backward(
            frame,
            v,
            _optional(v_alpha),
            _optional(v_depth),
            absolute=call.absolute,
            directions=call.directions,
            harmonics=ctx.needs_input_grad[1 + _INPUTS.index("sh_rest")],
        )
        call.screen.mean_gradient = torch.from_numpy(gradients.centres)
        if gradients.absolute is not None:
            call.screen.abs_gradient = torch.from_numpy(gradients.absolute)
        if gradients.directions is not None:
            call.screen.directions = torch.from_numpy(gradients.directions)
        colors = gradients.colors if frame.gaussians.colors is not None else None
        rest = gradients.rest if gradients.rest is not None and gradients.rest.shape[1] else None
        arrays = (
            gradients.means,
            gradients.quats,
            gradients.scales,
            gradients.opacities,
            colors,
            gradients.dc,
            rest,
        )
        named = zip(_INPUTS, arrays, strict=True)
        rows = call.screen.rows
        return None, *(_gradient(frame.gaussians, rows, name, array) for name, array in named)


def _gradient(
    gaussians: GaussianArrays, rows: Tensor | None, name: str, array: NDArray[np.float32] | None
) -> Tensor | None:
    """Return the gradient of one input, as sparse rows if they were requested."""
    if array is None:
        return None
    values = torch.from_numpy(array)
    if rows is None or name not in gaussians.sparse_rows:
        return values
    shape = (len(gaussians.means), *values.shape[1:])
    return torch.sparse_coo_tensor(rows[None], values, shape, check_invariants=False)
