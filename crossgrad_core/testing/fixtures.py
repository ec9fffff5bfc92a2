"""A small scene in memory, and what the hooks offer about it."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.testing.posed import posed_scene, posed_view

WIDTH, HEIGHT, FOCAL = 24, 16, 20.0
#: Steps of the schedule that contexts carry: the published one.
STEPS = 30_000

_VIEWS, _POINTS = 12, 40
_NEAR_RADIUS, _FAR_RADIUS, _STEP = 0.4, 0.8, 0.02
_CLOUD = 0.1


@dataclass(frozen=True)
class NoisePhoto:
    """A photo of random pixels that is the same each time.

    Attributes:
        seed: Seed of the pixels.
    """

    seed: int

    def image(self) -> Tensor:
        """[H, W, 3] uint8."""
        rng = np.random.default_rng(self.seed)
        return torch.from_numpy(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))

    def mask(self) -> Tensor | None:
        """None: every pixel counts."""
        return None


@cache
def sample_scene() -> Scene:
    """Six near and six far cameras around a small cloud; every fourth view is held out.

    The cameras of each regime are in a folder of their own, at different distances, so that every
    grouping finds its groups. The frame is a local one: extent 1.
    """
    rng = np.random.default_rng(7)
    cloud = rng.uniform(-_CLOUD, _CLOUD, (_POINTS, 3))
    scene = posed_scene([_view(index) for index in range(_VIEWS)], cloud, range(3, _VIEWS, 4))
    colors = rng.integers(0, 256, (_POINTS, 3), dtype=np.uint8)
    return replace(scene, name="sample", point_colors=colors)


def _view(index: int) -> View:
    """View `index`: the first half far and high, the second half near and low."""
    far = index < _VIEWS // 2
    angle = 2.4 * index
    radius = (_FAR_RADIUS if far else _NEAR_RADIUS) + _STEP * index
    height = 0.8 if far else 0.2
    flat = radius * np.sqrt(1.0 - height**2)
    center = np.array([flat * np.cos(angle), flat * np.sin(angle), radius * height])
    folder = "far" if far else "near"
    view = posed_view(center, f"{folder}/{index:03}.png", forward=-center, seen=range(_POINTS))
    camera = replace(
        view.camera, width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2
    )
    return replace(view, camera=camera, photo=NoisePhoto(index), regime=folder)


def sample_camera() -> Camera:
    """The first training camera of the sample scene."""
    return sample_scene().train_views[0].camera


def sample_gaussians(number: int = 30, *, harmonics: bool = False) -> Gaussians:
    """Gaussians of a few pixels in the sample scene, float32; all are leaves with gradients."""
    rng = np.random.default_rng(3)

    def leaf(values: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).requires_grad_()

    gaussians = Gaussians(
        means=leaf(rng.uniform(-_CLOUD, _CLOUD, (number, 3))),
        quats=leaf(rng.normal(size=(number, 4))),
        scales=leaf(rng.uniform(0.03, 0.08, (number, 3))),
        opacities=leaf(rng.uniform(0.2, 0.8, number)),
    )
    if not harmonics:
        return replace(gaussians, colors=leaf(rng.uniform(size=(number, 3))))
    return replace(
        gaussians,
        sh_dc=leaf(rng.uniform(-1.0, 1.0, (number, 1, 3))),
        sh_rest=leaf(rng.uniform(-0.1, 0.1, (number, 15, 3))),
        sh_degree=3,
    )


def sample_phase(step: int = STEPS, *, training: bool = True) -> Phase:
    """A moment of a run of the published length; by default the last step."""
    return Phase(step, training, Schedule.for_run(STEPS))


def step_fields(step: int = 1) -> dict[str, Any]:
    """The fields that every hook's context shares."""
    return {
        "step": step,
        "schedule": Schedule.for_run(STEPS),
        "scene": sample_scene(),
        "states": {},
        "rng": np.random.default_rng(0),
    }
