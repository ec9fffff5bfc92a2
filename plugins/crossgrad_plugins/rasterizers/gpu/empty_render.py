"""The render of no Gaussians, with which kernels of other packages are not bothered."""

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera, Gaussians, Render, Screen


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
