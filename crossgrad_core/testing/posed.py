"""Scenes in memory from camera positions, for samplers, groupings and statistics of cameras."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import SampleContext, StepRecord, ViewSample
from crossgrad_core.contract.sampler import Sampler
from crossgrad_core.contract.scene import Camera, Scene, Similarity, View
from crossgrad_core.contract.schedule import Schedule


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
    """A 4 x 4 view from `center` [3] along `forward` [3], held upright along `up` [3]."""
    z = _unit(np.asarray(forward, dtype=np.float64))
    x = _unit(np.cross(z, np.asarray(up, dtype=np.float64)))
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ np.asarray(center, dtype=np.float64)
    camera = Camera(4, 4, focal, focal, 2.0, 2.0, torch.from_numpy(pose))
    return View(name, camera, _Blank(), "all", np.array(seen, dtype=np.int64))


def posed_scene(views: Sequence[View], points: ArrayLike = (), test: Sequence[int] = ()) -> Scene:
    """A scene of these views that trains on all but the positions in `test`."""
    cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    train = tuple(i for i in range(len(views)) if i not in set(test))
    colors = np.zeros((len(cloud), 3), dtype=np.uint8)
    similarity = Similarity(np.zeros(3), 1.0)
    return Scene("posed", tuple(views), train, tuple(test), cloud, colors, similarity)


@dataclass
class SamplerRun:
    """Calls a sampler step by step as a training run does.

    Attributes:
        sampler: The sampler.
        scene: The scene.
        groups: Labels of the training views, or None.
        views_per_step: K; the sampler's usual one where None.
        steps: Length of the schedule.
        losses: [N] what each training view's loss is said to be.
        rng: The generator of the hook.
        state: The sampler's state.
        step: Number of steps taken.
        last: The last step's record.
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
        """The views of the next step."""
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
        """The views of the next `count` steps."""
        for _ in range(count):
            yield self.draw()

    def context(self) -> SampleContext:
        """What the sampler is offered in the present step."""
        views = self.scene.train_views
        centers = [view.camera.center.numpy() for view in views]
        return SampleContext(
            step=self.step,
            schedule=Schedule.for_run(self.steps),
            scene=self.scene,
            states={},
            rng=self.rng,
            views_per_step=self.views_per_step or self.sampler.usual_views,
            groups=self.groups,
            centers=np.stack(centers) if centers else np.zeros((0, 3)),
            last=self.last,
        )


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector))
