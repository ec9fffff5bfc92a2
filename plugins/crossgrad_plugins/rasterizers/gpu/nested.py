"""A drawing of another package in an autograd function, and the render of no Gaussians."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Camera, Gaussians, Render, Screen


@dataclass(frozen=True, eq=False)
class Drawing:
    """The results of another package.

    Attributes:
        outputs: Differentiable results.
        centers: The tensor whose gradient tells how the loss moves with the projected means.
    """

    outputs: tuple[Tensor, ...]
    centers: Tensor


@dataclass(frozen=True, eq=False)
class Call:
    """A drawing that is wanted.

    Attributes:
        draw: Draws, given the tensors.
        observe: Is given `Drawing.centers` and their gradient by every backward pass.
    """

    draw: Callable[[Sequence[Tensor]], Drawing]
    observe: Callable[[Tensor, Tensor], None]


def drawn(call: Call, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The outputs of a drawing, differentiable in `tensors`.

    The package's own graph is kept inside one node of ours. A hook on `centers` would refer to
    the tensor that it hangs on, and neither would ever be freed.
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
        known = [(output, g) for output, g in pairs if g is not None and output.requires_grad]
        wanted = [each for each in (drawing.centers, *ctx.leaves) if each.requires_grad]
        found = torch.autograd.grad(
            [output for output, _ in known],
            wanted,
            [gradient for _, gradient in known],
            retain_graph=True,  # Another backward pass may come.
            allow_unused=True,
        )
        by_tensor = {id(each): gradient for each, gradient in zip(wanted, found, strict=True)}
        if (of_centers := by_tensor.get(id(drawing.centers))) is not None:
            ctx.call.observe(drawing.centers, of_centers)
        return None, *(by_tensor.get(id(leaf)) for leaf in ctx.leaves)


def empty_render(
    gaussians: Gaussians, camera: Camera, background: Tensor, outputs: frozenset[str]
) -> Render:
    """The background, of which a gradient of zero comes back, and statistics of no rows."""
    # The sum of nothing is 0: through it every tensor is in the graph, as where one is drawn.
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
