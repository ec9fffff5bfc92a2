"""A scene whose photos are grey, each of one brightness."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.exposures import srgb

SIZE = 64


@dataclass(frozen=True)
class Grey:
    """A photo of one brightness in linear light."""

    light: float

    def image(self) -> Tensor:
        value = float(srgb.encoded(torch.tensor(self.light, dtype=torch.float64)))
        return torch.full((SIZE, SIZE, 3), round(255 * min(value, 1.0)), dtype=torch.uint8)

    def mask(self) -> Tensor | None:
        return None


def grey_scene(lights, points=60, seen=None):
    """Cameras side by side that look at a cloud; each photo has its own brightness."""
    rng = np.random.default_rng(1)
    cloud = np.column_stack([rng.uniform(-0.3, 0.3, points), np.full(points, 2.0),
                             rng.uniform(-0.3, 0.3, points)])  # fmt: skip
    views = []
    for number, light in enumerate(lights):
        shows = range(points) if seen is None else seen[number]
        view = posed_view((0.05 * number, 0, 0), f"{number:02}.png", seen=shows)
        camera = replace(view.camera, width=SIZE, height=SIZE, fx=80.0, fy=80.0, cx=32.0, cy=32.0)
        views.append(replace(view, camera=camera, photo=Grey(light)))
    return posed_scene(views, cloud)
