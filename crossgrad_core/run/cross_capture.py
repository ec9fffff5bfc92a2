"""The views of another capture of the same place, as a run sees them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.config import AUTO, ComponentChoice
from crossgrad_core.contract.scene import Camera, Scene, Similarity, View, centers_of
from crossgrad_core.errors import UserError
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.run.assemble import accepts, read_scene
from crossgrad_core.training.setup import Setup

#: A pose nearer than this to a training view's is that view: local units (extents), and radians.
SAME_PLACE, SAME_DIRECTION = 1e-3, 1e-2
#: Of the other capture's points at least this share lies in the box of the run's points and
#: cameras, made so much larger.
LEAST_SHARED, MARGIN = 0.1, 1.1
#: Points of captures of one place lie on the same surfaces: their distances from the run's have at
#: most this share of the median that they have however the capture is turned about its middle.
LEAST_ALIKE, TURNS = 0.4, 9
#: Points that are looked at, at least and of either scene at most.
FEWEST_POINTS, MOST_POINTS, MOST_OWN = 200, 2_000, 50_000


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """Another capture in the local frame of a run.

    Attributes:
        name: Its name.
        views: Those of its views that the run was not trained on.
        points: [P, 3] its SfM points.
        trained: How many of its views the run was trained on.
        alike: Whether its points lie where those of the run lie, as far as that can be told.
    """

    name: str
    views: tuple[View, ...]
    points: NDArray[np.float64]
    trained: int
    alike: bool = True

    def messages(self) -> list[str]:
        """What the user should know of it."""
        told = []
        if not self.alike:
            told.append(
                "the points of this scene lie hardly nearer to the run's than if it were turned at "
                "random: look at its renders; is it the same place, in the same coordinates?"
            )
        if self.trained:
            told.append(f"left out: {self.trained} of its views that the run was trained on")
        return told


def elsewhere(setup: Setup, path: Path) -> Elsewhere:
    """The views of another scene in the same input coordinates, in the size of the run's photos.

    Raises:
        UserError: It cannot be read, lies elsewhere, or the run was trained on all of its views.
    """
    reading = {"split": "none", "masks": None, "init": "random", "points": None}
    config = setup.config.model_copy(
        update={
            "data": setup.config.data.model_copy(update=reading),
            "reader": _reader(setup, path),
        }
    )
    other, _ = read_scene(config, path)
    frame = setup.scene.similarity
    points = frame.to_local(other.similarity.to_input(other.points))
    moved = [replace(view, camera=_moved(view.camera, other, frame)) for view in other.views]
    _check_place(setup.scene, points, centers_of(moved), path)
    trained = _are_trained(moved, setup.train_views)
    views = tuple(view for view, known in zip(moved, trained, strict=True) if not known)
    if not views:
        raise UserError(
            "the run was trained on all views of this scene",
            where=f"--on {path}",
            todo="name another capture of the place; leave --on out for the held-out views",
        )
    alike = _alike(setup.scene.points, points)
    return Elsewhere(other.name, views, points, len(moved) - len(views), alike)


def _reader(setup: Setup, path: Path) -> ComponentChoice:
    """How the other scene is read: as the run's own where that can be, which others could, too."""
    own, scene = setup.config.reader, setup.config.scene
    if scene is not None and path.resolve() == Path(scene).resolve():
        return own
    fits = own.name != AUTO and accepts(own.name, path)
    return ComponentChoice(name=own.name if fits else AUTO)


def _moved(camera: Camera, other: Scene, similarity: Similarity) -> Camera:
    """The camera of another scene's local frame in the frame of `similarity`."""
    rotation = camera.world_to_camera[:3, :3]
    center = other.similarity.to_input(camera.center.numpy()[None])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.from_numpy(similarity.to_local(center)[0])
    return replace(camera, world_to_camera=pose)


def _are_trained(views: Sequence[View], trained: Sequence[View]) -> list[bool]:
    """Whether the pose of each view is that of a training view."""
    centers, rotations = centers_of(trained), _rotations_of(trained)
    # The trace of the rotation from one camera to the other falls with its angle.
    least = 1.0 + 2.0 * math.cos(SAME_DIRECTION)

    def is_trained(center: NDArray[np.float64], rotation: NDArray[np.float64]) -> bool:
        near = np.linalg.norm(centers - center, axis=1) <= SAME_PLACE
        alike = np.einsum("nij,ij->n", rotations, rotation) >= least
        return bool((near & alike).any())

    return list(map(is_trained, centers_of(views), _rotations_of(views)))


def _rotations_of(views: Sequence[View]) -> NDArray[np.float64]:
    """[V, 3, 3] world to camera."""
    return np.stack([view.camera.world_to_camera[:3, :3].numpy() for view in views])


def _check_place(
    scene: Scene, points: NDArray[np.float64], centers: NDArray[np.float64], path: Path
) -> None:
    """Refuses a capture in other coordinates: what it shows is not where the run's scene is."""
    own = np.concatenate([scene.points, scene.robust_centers])
    middle, half = (own.max(axis=0) + own.min(axis=0)) / 2, np.ptp(own, axis=0) / 2
    what = points if len(points) else centers
    share = float(np.mean(np.all(np.abs(what - middle) <= MARGIN * half, axis=1)))
    if share < LEAST_SHARED:
        raise UserError(
            "this scene lies elsewhere",
            where=f"--on {path}",
            expected="a capture of the same place, in the coordinates of the run's scene",
            found=f"{share:.0%} of its points lie within the run's",
            todo="align the two models first, or find the poses of all photos in one go",
        )


def _alike(own: NDArray[np.float64], points: NDArray[np.float64]) -> bool:
    """Whether points lie near those of the run, and would not if they were turned."""
    from scipy.spatial import cKDTree

    # What lies beyond the run's points says nothing: it may show more of the place.
    points = points[((points >= own.min(axis=0)) & (points <= own.max(axis=0))).all(axis=1)]
    if min(len(own), len(points)) < FEWEST_POINTS:
        return True
    tree = cKDTree(_some(own, MOST_OWN))
    some = _some(points, MOST_POINTS)
    middle = np.median(some, axis=0)
    turns = torch.randn(TURNS, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def away(where: NDArray[np.float64]) -> float:
        return float(np.median(tree.query(where)[0]))

    turned = [(some - middle) @ each.T + middle for each in rotation_matrices(turns).numpy()]
    return away(some) <= LEAST_ALIKE * min(map(away, turned))


def _some(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """At most so many points, evenly spread over their order."""
    return points[:: -(-len(points) // most)]
