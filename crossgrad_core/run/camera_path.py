"""Cameras without photos: a path from a file, or a zoom path from far photos to near photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, radians, tan
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.registry.validation import as_user_error
from crossgrad_core.scene.raw import FARTHEST, FARTHEST_LOCAL
from crossgrad_core.system.text_files import read_json

#: Name of the built-in camera path from the farthest photos to the nearest photos.
ZOOM: Final = "zoom"
FRAMES_PER_SECOND: Final = 24.0
#: Number of frames of a zoom path.
FRAMES: Final = 120
#: Minimum number of SfM points that a view of a zoom path observes. With fewer points, the distance
#: between the camera and the scene is unreliable.
FEWEST_SEEN: Final = 8
#: Maximum number of views from which the ends of a zoom path are chosen. If there are more views,
#: every n-th view is used.
MOST_VIEWS: Final = 500
_TODO: Final = "write the file with nerfstudio's viewer, or as described in docs/runs.md"
#: Maximum number of frames of a camera path. A longer path is probably a mistake.
MOST_FRAMES: Final = 100_000
_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras in the local frame, one per frame.

    Attributes:
        name: Name of the path, which is a part of the names of output files.
        cameras: The cameras, one per frame.
        fps: Frames per second.
    """

    name: str
    cameras: tuple[Camera, ...]
    fps: float = FRAMES_PER_SECOND


def camera_path(scene: Scene, path: str, frames: int) -> CameraPath:
    """Return the cameras of a path.

    Args:
        scene: The scene of the run.
        path: `zoom`, or the file of a camera path in the format of nerfstudio's viewer, in input
            coordinates.
        frames: Number of frames of a zoom path.

    Raises:
        UserError: The file does not exist or contains no path, or the photos give no zoom path.
    """
    if path == ZOOM:
        return CameraPath(ZOOM, zoom_path(scene.train_views, scene.points, frames))
    return _read(Path(path), scene.similarity)


def zoom_path(views: Sequence[View], points: _Floats, frames: int) -> tuple[Camera, ...]:
    """Return cameras on a line from a far photo to a near photo of the same points.

    The distance to the points shrinks by the same factor in each frame. One end of the path is
    among the farthest fifth of the views, the other end among the nearest fifth. The pair with the
    most common SfM points is used; among equal pairs, the pair with the most similar viewing
    directions.

    Args:
        views: The training views.
        points: [P, 3] SfM points.
        frames: Number of frames, at least 2.

    Raises:
        UserError: Fewer than two views observe enough SfM points.
    """
    usable = [view for view in views if len(view.seen) >= FEWEST_SEEN]
    usable = usable[:: 1 + len(usable) // MOST_VIEWS]
    if len(usable) < 2:  # noqa: PLR2004 - two ends
        raise UserError(
            "no zoom path can be computed from the photos",
            where=f"--path {ZOOM}",
            expected=f"two photos that each observe at least {FEWEST_SEEN} SfM points",
            found=f"{len(usable)}",
            todo="give a camera path as a file: --path FILE.json",
        )
    distances = np.array([_distance(view.camera, points[view.seen]) for view in usable])
    first, last = _ends(usable, distances, len(points))
    nearer = distances[last] / distances[first]
    ends = usable[first].camera, usable[last].camera
    return tuple(_between(*ends, share, nearer) for share in np.linspace(0.0, 1.0, frames))


def _distance(camera: Camera, seen: _Floats) -> float:
    """Return the median depth of the points that a camera observes, in local units."""
    depths = camera.local(seen)[:, 2]
    return float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0


def _ends(views: Sequence[View], distances: _Floats, points: int) -> tuple[int, int]:
    order, few = np.argsort(distances, kind="stable"), max(1, len(views) // 5)
    forward = np.stack([view.camera.world_to_camera[2, :3].numpy() for view in views])
    seen = {int(near): np.unique(views[near].seen) for near in order[:few]}
    candidates = []
    for far in map(int, order[-few:]):
        mark = np.zeros(points, dtype=np.bool_)
        mark[views[far].seen] = True
        candidates += [
            (int(mark[rows].sum()), float(forward[far] @ forward[near]), (far, near))
            for near, rows in seen.items()
            if near != far
        ]
    return max(candidates)[2]


def _way(share: float, nearer: float) -> float:
    """Return the position on the line of a zoom path, from 0 to 1.

    At this position, the distance to the points is `nearer ** share` times the first distance.
    """
    if abs(nearer - 1.0) < 1e-6:  # noqa: PLR2004 - the limit of the next formula
        return share
    return float((1.0 - nearer**share) / (1.0 - nearer))


def _between(first: Camera, last: Camera, share: float, nearer: float) -> Camera:
    """Return the camera after a share of all frames; direction and field of view change evenly."""
    ends = first.world_to_camera.numpy(), last.world_to_camera.numpy()
    down, ahead = ((1.0 - share) * ends[0][row, :3] + share * ends[1][row, :3] for row in (1, 2))
    forward = _unit(ahead)
    right = _unit(np.cross(down, forward))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    way = _way(share, nearer)
    center = (1.0 - way) * first.center.numpy() + way * last.center.numpy()
    pose[:3, 3] = -pose[:3, :3] @ center
    zoom = (last.fx / last.width / (first.fx / first.width)) ** share
    return replace(
        first, fx=first.fx * zoom, fy=first.fy * zoom, cx=first.width / 2, cy=first.height / 2,
        world_to_camera=torch.from_numpy(pose),
    )  # fmt: skip


def _unit(vector: _Floats) -> _Floats:
    return np.asarray(vector / np.linalg.norm(vector))


class _Frame(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    camera_to_world: list[Annotated[float, Field(strict=True, ge=-FARTHEST, le=FARTHEST)]] = Field(
        min_length=16, max_length=16
    )
    fov: float = Field(strict=True, ge=0.01, lt=180)


class _Path(BaseModel):
    """A file of nerfstudio's viewer: OpenGL axes, matrices row by row, vertical field of view."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    camera_path: list[_Frame] = Field(min_length=1, max_length=MOST_FRAMES)
    render_width: float = Field(strict=True, ge=1, le=16_384, multiple_of=1)
    render_height: float = Field(strict=True, ge=1, le=16_384, multiple_of=1)
    fps: float = Field(FRAMES_PER_SECOND, strict=True, ge=0.01, le=1_000)
    camera_type: Literal["perspective"] = "perspective"


def _read(path: Path, similarity: Similarity) -> CameraPath:
    try:
        content = _Path.model_validate(read_json(path))
    except ValidationError as error:
        raise as_user_error(error, _Path, subject=f"camera path {path}", todo=_TODO) from error
    except (FileNotFoundError, ValueError) as error:
        raise UserError(
            "the camera path cannot be read", where=f"--path {path}", found=str(error), todo=_TODO
        ) from error
    size = round(content.render_width), round(content.render_height)
    cameras = [_camera(frame, size, similarity, path) for frame in content.camera_path]
    return CameraPath(path.stem, tuple(cameras), content.fps)


def _camera(frame: _Frame, size: tuple[int, int], similarity: Similarity, path: Path) -> Camera:
    matrix = np.array(frame.camera_to_world).reshape(4, 4)
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise UserError(
            "the last row of a camera's pose is wrong",
            where=f"{path}, camera_to_world",
            expected="16 numbers, row by row; the last four are 0, 0, 0, 1",
            found=str(matrix[3].tolist()),
            todo=_TODO,
        )
    turned = matrix[:3, :3] * np.array([1.0, -1.0, -1.0])
    lengths = np.linalg.norm(turned, axis=0)
    rotation = turned / np.where(lengths > 0, lengths, 1.0)
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise UserError(
            "the pose of a camera contains no valid rotation",
            where=f"{path}, camera_to_world",
            expected="three orthogonal axes, right-handed",
            found=str(frame.camera_to_world),
            todo=_TODO,
        )
    center = similarity.to_local(matrix[None, :3, 3])[0]
    if np.abs(center).max() > FARTHEST_LOCAL:
        raise UserError(
            "a camera of the path is too far from the scene",
            where=f"{path}, camera_to_world",
            expected=f"at most {FARTHEST_LOCAL:g} times the extent of the training cameras",
            found=str(matrix[:3, 3].tolist()),
            todo=_TODO,
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ center
    focal = size[1] / 2 / tan(radians(frame.fov) / 2)
    return Camera(*size, focal, focal, size[0] / 2, size[1] / 2, torch.from_numpy(pose))


def checked_camera(camera: object) -> Camera:
    """Return the camera if it is valid.

    Raises:
        UserError: The input is not a camera, or one of its numbers is not valid for a camera.
    """
    if not isinstance(camera, Camera):
        raise _refused("the name of a view, or a camera", f"{type(camera).__name__}")
    sides = {"width": camera.width, "height": camera.height}
    for name, side in sides.items():
        if not isinstance(side, Integral) or isinstance(side, bool) or side < 1:
            raise _refused(f"a {name} of at least 1 pixel", repr(side))
    for name in ("fx", "fy", "cx", "cy"):
        value, focal = getattr(camera, name), name in {"fx", "fy"}
        is_finite = isinstance(value, Real) and isfinite(value)
        if not is_finite or (focal and value <= 0):
            above = " above 0" if focal else ""
            raise _refused(f"a finite {name}{above}, in pixels", repr(value))
    if not _is_pose(camera.world_to_camera):
        raise _refused(
            "world_to_camera as a [4, 4] tensor of a rotation and a translation",
            str(camera.world_to_camera).replace("\n", ""),
        )
    return camera


def _is_pose(pose: object) -> bool:
    if not isinstance(pose, Tensor) or pose.shape != (4, 4) or not bool(pose.isfinite().all()):
        return False
    pose = pose.detach().cpu().double()
    rotation, last = pose[:3, :3], pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    straight = torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=pose.dtype), atol=1e-3)
    return straight and float(torch.det(rotation)) > 0 and torch.allclose(pose[3], last)


def _refused(expected: str, found: str) -> UserError:
    return UserError(
        "the argument is not a camera that can be rendered",
        where="Run.render",
        expected=expected,
        found=found,
        todo="use one of `run.scene.views`, or a copy made with `dataclasses.replace`",
    )
