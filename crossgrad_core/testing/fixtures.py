"""Small scenes in memory, with or without content, and hook contexts for these scenes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import SampleContext, StepRecord, ViewSample
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.contract.slots.sampler import Sampler

WIDTH, HEIGHT, FOCAL = 24, 16, 20.0
#: Length of the schedule in the contexts: the published length.
STEPS = 30_000
_VIEWS, _POINTS = 12, 40
_NEAR_RADIUS, _FAR_RADIUS, _STEP = 0.4, 0.8, 0.02
_CLOUD = 0.1


@dataclass(frozen=True)
class NoisePhoto:
    """A photo with random pixels, which are equal in every call.

    Attributes:
        seed: Seed of the random pixels.
    """

    seed: int

    def image(self) -> Tensor:
        """Return the pixels [H, W, 3] uint8."""
        rng = np.random.default_rng(self.seed)
        return torch.from_numpy(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))

    def mask(self) -> Tensor | None:
        """Return None, because all pixels are valid."""
        return None


@cache
def sample_scene() -> Scene:
    """Create a small point cloud that six near and six far cameras surround.

    Every fourth view is held out.

    The cameras of each regime are in their own folder and at their own range of distances. Every
    grouping therefore finds its groups. The scene is already in a local frame: the extent of its
    cameras is 1.
    """
    rng = np.random.default_rng(7)
    cloud = rng.uniform(-_CLOUD, _CLOUD, (_POINTS, 3))
    scene = posed_scene([_view(index) for index in range(_VIEWS)], cloud, range(3, _VIEWS, 4))
    colors = rng.integers(0, 256, (_POINTS, 3), dtype=np.uint8)
    return replace(scene, name="sample", point_colors=colors)


def _view(index: int) -> View:
    """Create view `index`.

    The first half of the views is far and high, the second half near and low.
    """
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
    """Return the first training camera of the sample scene."""
    return sample_scene().train_views[0].camera


def sample_gaussians(number: int = 30, *, harmonics: bool = False) -> Gaussians:
    """Create float32 Gaussians of a few pixels for the sample scene.

    All tensors are leaf tensors that require gradients.
    """
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
    """Return the phase of a step in a run of the published length. The default is the last step."""
    return Phase(step, training, Schedule.for_run(STEPS))


def step_fields(step: int = 1) -> dict[str, Any]:
    """Return the fields that all hook contexts share."""
    return {
        "step": step,
        "schedule": Schedule.for_run(STEPS),
        "scene": sample_scene(),
        "states": {},
        "rng": np.random.default_rng(0),
    }


class _Blank:
    """A black 4 x 4 photo."""

    def image(self) -> Tensor:
        return torch.zeros(4, 4, 3, dtype=torch.uint8)

    def mask(self) -> Tensor | None:
        return None


def posed_view(
    center: ArrayLike,
    name: str = "view.png",
    *,
    forward: ArrayLike = (0.0, 1.0, 0.0),
    up: ArrayLike = (0.0, 0.0, 1.0),
    focal: float = 4.0,
    seen: Sequence[int] = (),
) -> View:
    """Create a 4 x 4 view at `center` [3].

    The view looks along `forward` [3], and its top is towards `up` [3].
    """
    z = _unit(np.asarray(forward, dtype=np.float64))
    x = _unit(np.cross(z, np.asarray(up, dtype=np.float64)))
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ np.asarray(center, dtype=np.float64)
    camera = Camera(4, 4, focal, focal, 2.0, 2.0, torch.from_numpy(pose))
    return View(name, camera, _Blank(), "all", np.array(seen, dtype=np.int64))


def posed_scene(views: Sequence[View], points: ArrayLike = (), test: Sequence[int] = ()) -> Scene:
    """Create a scene of the given views.

    All views except the views in `test` are training views.
    """
    cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    train = tuple(i for i in range(len(views)) if i not in set(test))
    colors = np.zeros((len(cloud), 3), dtype=np.uint8)
    similarity = Similarity(np.zeros(3), 1.0)
    return Scene("posed", tuple(views), train, tuple(test), cloud, colors, similarity)


@dataclass
class SamplerRun:
    """A sampler that is called step by step, as in a training run.

    Attributes:
        sampler: The sampler.
        scene: The scene.
        groups: Labels of the training views; None without groups.
        views_per_step: Number of views K in each step; None uses the sampler's default.
        steps: Number of steps in the schedule.
        losses: [N] loss of each training view, as reported to the sampler.
        rng: The random generator that the hook receives.
        state: The present state of the sampler.
        step: Number of completed steps.
        last: The record of the last step.
    """

    sampler: Sampler
    scene: Scene
    groups: tuple[str, ...] | None = None
    views_per_step: int | None = None
    steps: int = 30_000
    losses: Sequence[float] | None = None
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    state: PluginState = field(default_factory=PluginState)
    step: int = 0
    last: StepRecord | None = None

    def draw(self) -> ViewSample:
        """Return the views of the next step."""
        self.step += 1
        draw, self.state = self.sampler.sample(self.context(), self.state)
        losses = self.losses or [1.0] * len(self.scene.train)
        self.last = StepRecord(
            step=self.step,
            views=draw.views,
            names=tuple(self.scene.train_views[view].name for view in draw.views),
            labels=draw.labels,
            losses=tuple(losses[view] for view in draw.views),
            primitives=1,
            counts={},
            train_seconds=0.0,
        )
        return draw

    def draws(self, count: int) -> Iterator[ViewSample]:
        """Yield the views of the next `count` steps."""
        for _ in range(count):
            yield self.draw()

    def context(self) -> SampleContext:
        """Return the context of the sampler for the present step."""
        views = self.scene.train_views
        centers = [view.camera.center.numpy() for view in views]
        return SampleContext(
            step=self.step,
            schedule=Schedule.for_run(self.steps),
            scene=self.scene,
            states={},
            rng=self.rng,
            views_per_step=self.views_per_step or self.sampler.resolved_views,
            groups=self.groups,
            centers=np.stack(centers) if centers else np.zeros((0, 3)),
            last=self.last,
        )


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector))
