"""The render of no Gaussians, with which kernels of other packages are not bothered."""

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera, Render, Screen


def nothing_drawn(camera: Camera, background: Tensor, outputs: frozenset[str]) -> Render:
    """The background, and statistics of no rows."""
    image = background.expand(camera.height, camera.width, 3)
    alpha = torch.zeros_like(image[..., 0])
    none = torch.zeros(0, dtype=torch.int32, device=background.device)
    screen = Screen(
        radii=none,
        pixels=none if "pixels" in outputs else None,
        count=(lambda _marked: none) if "count" in outputs else None,
    )
    return Render(image, alpha, screen, alpha if "depth" in outputs else None)
