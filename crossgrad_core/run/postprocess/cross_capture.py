"""The views of another capture of the same place, in the local frame of a run."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.config import AUTO, ComponentChoice
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import Camera, Scene, View, centers_of
from crossgrad_core.errors import UserError
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.run.assemble import accepts, read_scene
from crossgrad_core.training.setup import Setup

#: Largest differences in position (local units) and in direction (radians) between a view and a
#: training view. A view within both limits counts as this training view.
SAME_PLACE, SAME_DIRECTION = 1e-3, 1e-2
#: Smallest share of a capture's points inside a box, and the factor that enlarges the box. The box
#: contains the run's points and cameras.
LEAST_SHARED, MARGIN = 0.1, 1.1
#: Largest accepted ratio of two median distances of points, and number of random rotations. The
#: points of two captures of one place are on the same surfaces. Therefore the capture's points are
#: much nearer to the run's points than after a random rotation about the middle of the capture.
LEAST_ALIKE, TURNS = 0.4, 9
#: Minimum number of points for the test with random rotations, maximum number of points from the
#: other capture, and maximum number of points from the run.
FEWEST_POINTS, MOST_POINTS, MOST_OWN = 200, 2_000, 50_000


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """Another capture in the local frame of a run.

    Attributes:
        name: Name of the capture.
        views: The views of the capture, except the views that the run was trained on.
        points: [P, 3] the SfM points of the capture.
        trained: Number of views of the capture that the run was trained on.
        alike: True if the points match the run's points, or if there are too few points for a
            decision.
    """

    name: str
    views: tuple[View, ...]
    points: NDArray[np.float64]
    trained: int
    alike: bool = True

    def messages(self) -> list[str]:
        """Return messages for the user about this capture."""
        messages = []
        if not self.alike:
            messages.append(
                "the points of this capture match the scene of the run hardly better than "
                "after a random rotation: check the renders, and check that the capture and the "
                "run show the same place in the same coordinates"
            )
        if self.trained:
            messages.append(f"left out: {self.trained} views that the run was trained on")
        return messages


def elsewhere(setup: Setup, path: Path) -> Elsewhere:
    """Return the views of another scene in the same input coordinates, at the run's photo size.

    Raises:
        UserError: The scene cannot be read or is in another place, or the run was trained on all
            views of the scene.
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
    views = tuple(view for view, is_trained in zip(moved, trained, strict=True) if not is_trained)
    if not views:
        raise UserError(
            "there are no views to evaluate: the run was trained on all views of this scene",
            where=f"--on {path}",
            todo="name another capture of the same place, or leave --on out to evaluate the "
            "held-out views",
        )
    alike = _alike(setup.scene.points, points)
    return Elsewhere(other.name, views, points, len(moved) - len(views), alike)


def _reader(setup: Setup, path: Path) -> ComponentChoice:
    """Return the run's reader if it accepts the folder of the other scene, else `auto`."""
    run_reader, scene = setup.config.reader, setup.config.scene
    if scene is not None and path.resolve() == Path(scene).resolve():
        return run_reader
    fits = run_reader.name != AUTO and accepts(run_reader.name, path)
    return ComponentChoice(name=run_reader.name if fits else AUTO)


def _moved(camera: Camera, other: Scene, similarity: Similarity) -> Camera:
    """Return a camera in the local frame of `other`, moved to the frame of `similarity`."""
    rotation = camera.world_to_camera[:3, :3]
    center = other.similarity.to_input(camera.center.numpy()[None])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.from_numpy(similarity.to_local(center)[0])
    return replace(camera, world_to_camera=pose)


def _are_trained(views: Sequence[View], trained: Sequence[View]) -> list[bool]:
    """Return for each view whether its pose is the pose of a training view."""
    centers, rotations = centers_of(trained), _rotations_of(trained)
    # Smallest trace of the rotation between two cameras with the same direction. The trace
    # decreases when the angle between the cameras increases.
    least = 1.0 + 2.0 * math.cos(SAME_DIRECTION)

    def is_trained(center: NDArray[np.float64], rotation: NDArray[np.float64]) -> bool:
        near = np.linalg.norm(centers - center, axis=1) <= SAME_PLACE
        alike = np.einsum("nij,ij->n", rotations, rotation) >= least
        return bool((near & alike).any())

    return list(map(is_trained, centers_of(views), _rotations_of(views)))


def _rotations_of(views: Sequence[View]) -> NDArray[np.float64]:
    """Return the rotations of the views, [V, 3, 3], world to camera."""
    return np.stack([view.camera.world_to_camera[:3, :3].numpy() for view in views])


def _check_place(
    scene: Scene, points: NDArray[np.float64], centers: NDArray[np.float64], path: Path
) -> None:
    """Refuse a capture whose points are outside the run's scene, because its coordinates differ."""
    scene_points = np.concatenate([scene.points, scene.robust_centers])
    middle, half = (
        (scene_points.max(axis=0) + scene_points.min(axis=0)) / 2,
        np.ptp(scene_points, axis=0) / 2,
    )
    what = points if len(points) else centers
    share = float(np.mean(np.all(np.abs(what - middle) <= MARGIN * half, axis=1)))
    if share < LEAST_SHARED:
        raise UserError(
            "the other capture does not overlap with the scene of the run",
            where=f"--on {path}",
            expected="a capture of the same place, in the coordinate system of the run's scene",
            found=f"{share:.0%} of the capture's points are inside the run's scene",
            todo="align the two models first, or estimate the poses of all photos together",
        )


def _alike(run_points: NDArray[np.float64], points: NDArray[np.float64]) -> bool:
    """Return True if `points` match the run's points better than after a random rotation.

    Also return True if there are too few points for a decision.
    """
    from scipy.spatial import cKDTree

    # Ignore points outside the box of the run's points, because the other capture may show a larger
    # area.
    points = points[
        ((points >= run_points.min(axis=0)) & (points <= run_points.max(axis=0))).all(axis=1)
    ]
    if min(len(run_points), len(points)) < FEWEST_POINTS:
        return True
    tree = cKDTree(_some(run_points, MOST_OWN))
    sample = _some(points, MOST_POINTS)
    middle = np.median(sample, axis=0)
    turns = torch.randn(TURNS, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def away(where: NDArray[np.float64]) -> float:
        return float(np.median(tree.query(where)[0]))

    turned = [
        (sample - middle) @ rotation.T + middle for rotation in rotation_matrices(turns).numpy()
    ]
    return away(sample) <= LEAST_ALIKE * min(map(away, turned))


def _some(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Return at most `most` points: every n-th point."""
    return points[:: -(-len(points) // most)]
