"""Renders of other packages inside one autograd function, and renders without Gaussians."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Camera, Gaussians, Render, Screen


@dataclass(frozen=True, eq=False)
class Drawing:
    """The results of another package's rasterizer.

    Attributes:
        outputs: Differentiable outputs of the package.
        centers: The package's tensor of projected means, whose gradient is needed.
    """

    outputs: tuple[Tensor, ...]
    centers: Tensor


@dataclass(frozen=True, eq=False)
class Call:
    """A call of another package's rasterizer.

    Attributes:
        draw: Function that renders the given tensors.
        observe: Function that each backward pass calls with `Drawing.centers` and the gradient of
            this tensor.
    """

    draw: Callable[[Sequence[Tensor]], Drawing]
    observe: Callable[[Tensor, Tensor], None]


def drawn(call: Call, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the outputs of a drawing, with gradients with respect to `tensors`.

    The autograd graph of the package is stored inside one autograd node. A hook on `centers` is not
    used, because the hook and its tensor would refer to each other, and their memory would never be
    freed.
    """
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        outputs: tuple[Tensor, ...] = _Nested.apply(call, *tensors)  # type: ignore[no-untyped-call]
        return outputs
    return call.draw(tensors).outputs


class _Nested(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, call: Call, *tensors: Tensor) -> Any:
        pairs = zip(tensors, ctx.needs_input_grad[1:], strict=True)
        leaves = [tensor.detach().requires_grad_(needs) for tensor, needs in pairs]
        with torch.enable_grad():
            drawing = call.draw(leaves)
        ctx.call, ctx.leaves, ctx.drawing = call, leaves, drawing
        ctx.set_materialize_grads(False)
        return tuple(output.detach() for output in drawing.outputs)

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        drawing: Drawing = ctx.drawing
        pairs = zip(drawing.outputs, gradients, strict=True)
        with_gradient = [
            (output, g) for output, g in pairs if g is not None and output.requires_grad
        ]
        wanted = [tensor for tensor in (drawing.centers, *ctx.leaves) if tensor.requires_grad]
        input_gradients = torch.autograd.grad(
            [output for output, _ in with_gradient],
            wanted,
            [gradient for _, gradient in with_gradient],
            retain_graph=True,  # Keep the graph, because another backward pass may follow.
            allow_unused=True,
        )
        by_tensor = {
            id(tensor): gradient for tensor, gradient in zip(wanted, input_gradients, strict=True)
        }
        if (of_centers := by_tensor.get(id(drawing.centers))) is not None:
            ctx.call.observe(drawing.centers, of_centers)
        return None, *(by_tensor.get(id(leaf)) for leaf in ctx.leaves)


def empty_render(
    gaussians: Gaussians, camera: Camera, background: Tensor, outputs: frozenset[str]
) -> Render:
    """Return the background, with zero gradients and with screen statistics of zero rows."""
    # The sum of an empty tensor is 0. Adding it connects every tensor to the graph, as in a normal
    # render.
    zero = torch.stack([tensor.sum() for tensor in gaussians.floats()]).sum()
    image = background.expand(camera.height, camera.width, 3) + zero
    alpha = torch.zeros_like(image[..., 0])
    none = torch.zeros(0, dtype=torch.int32, device=background.device)
    screen = Screen(
        radii=none,
        mean_gradient=image.new_zeros(0, 2),
        abs_gradient=image.new_zeros(0, 2) if "abs_gradient" in outputs else None,
        pixels=none if "pixels" in outputs else None,
        count=(lambda _marked: none) if "count" in outputs else None,
    )
    return Render(image, alpha, screen, alpha if "depth" in outputs else None)
