"""The data types of a scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.georeference import UNPLACED, Georeference
from crossgrad_core.contract.similarity import Similarity
from crossgrad_core.contract.state import Json
from crossgrad_core.contract.strays import stray_rows


@dataclass(frozen=True, eq=False)
class Pinhole:
    """An undistorted calibration; pixels, pixel centres at +0.5.

    Attributes:
        width: Pixels.
        height: Pixels.
        fx: Focal length in pixels; likewise `fy`.
        fy: See `fx`.
        cx: Principal point in pixels from the left (top for `cy`) image border.
        cy: See `cx`.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> Self:
        """The same calibration for an image resampled to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )


@dataclass(frozen=True, eq=False)
class Camera(Pinhole):
    """A pinhole camera: OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    Attributes:
        world_to_camera: [4, 4] float64 on the CPU, rigid, local frame to camera frame.
    """

    world_to_camera: Tensor

    @cached_property
    def center(self) -> Tensor:
        """[3] float64, the camera centre in the local frame."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @cached_property
    def matrix(self) -> Tensor:
        """[3, 3] float64, the calibration matrix K."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] points of the local frame in the camera's axes; the third number is the depth."""
        pose = self.world_to_camera.numpy()
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def project(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """[N, 2] pixels (x right, y down) and [N] depths of [N, 3] points of the local frame.

        Pixels of points that do not lie in front of the camera mean nothing, but are numbers.
        """
        x, y, depth = self.local(points).T
        inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
        across, down = self.fx * x * inverse, self.fy * y * inverse
        return np.column_stack([across + self.cx, down + self.cy]), depth


class Photo(Protocol):
    """A photo that is decoded when it is asked for."""

    def image(self) -> Tensor:
        """[H, W, 3] uint8, RGB, in the size of the view's camera."""
        ...

    def mask(self) -> Tensor | None:
        """[H, W] bool, True where the pixel counts; None where every pixel counts."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """A camera with its photo, its unique name (path below the image folder) and its regime.

    Attributes:
        name: Path relative to the image folder with forward slashes.
        camera: The camera, in the size of the photo as trained.
        photo: The decoded-on-demand photo.
        regime: Label under which results are reported.
        seen: [S] int64 indices of the SfM points that this view observed; may be empty.
    """

    name: str
    camera: Camera
    photo: Photo
    regime: str
    seen: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a run knows about a place.

    Attributes:
        name: Short name, used for the output folder.
        views: All views, sorted by name.
        train: Positions in `views` that are trained on.
        test: Positions in `views` that are held out.
        points: [P, 3] float64 SfM points, local frame.
        point_colors: [P, 3] uint8 RGB.
        similarity: Maps the local frame back to the input frame.
        notes: What was done to the input and why (undistorted, resized, images left out ...).
        point_sizes: [P] standard deviations of the first Gaussians, local units; NaN where the
            distance to neighbours tells. None: at all points.
        point_opacities: [P] their opacities; NaN where the backbone's rule holds. None likewise.
        georeference: Where on Earth it is.
        files: Files that it was read from, except photos and masks.
        check: Figures of the check of the scene against itself; None before the check.
    """

    name: str
    views: tuple[View, ...]
    train: tuple[int, ...]
    test: tuple[int, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    similarity: Similarity
    notes: tuple[str, ...] = ()
    point_sizes: NDArray[np.float64] | None = None
    point_opacities: NDArray[np.float64] | None = None
    georeference: Georeference = UNPLACED
    files: tuple[Path, ...] = ()
    check: Mapping[str, Json] | None = None

    def with_points(self, rows: NDArray[np.int64]) -> "Scene":
        """The scene with these of its points alone, [Q] rising; views know their new rows."""
        place = np.full(len(self.points), -1)
        place[rows] = np.arange(len(rows))

        def left(view: View) -> View:
            seen = place[view.seen]
            return replace(view, seen=seen[seen >= 0])

        sizes, opacities = self.point_sizes, self.point_opacities
        return replace(
            self,
            views=tuple(map(left, self.views)),
            points=self.points[rows],
            point_colors=self.point_colors[rows],
            point_sizes=None if sizes is None else sizes[rows],
            point_opacities=None if opacities is None else opacities[rows],
        )

    @cached_property
    def train_views(self) -> tuple[View, ...]:
        """The training views, in the order that samplers index."""
        return tuple(self.views[i] for i in self.train)

    @cached_property
    def train_pixels(self) -> float:
        """Pixels of a training photo, mean; 0 without any."""
        pixels = [view.camera.width * view.camera.height for view in self.train_views]
        return sum(pixels) / max(1, len(pixels))

    @cached_property
    def test_views(self) -> tuple[View, ...]:
        """The held-out views."""
        return tuple(self.views[i] for i in self.test)

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """[N, 3] float64 camera centres of the training views, local frame."""
        return centers_of(self.train_views)

    @cached_property
    def robust_centers(self) -> NDArray[np.float64]:
        """[M, 3] training camera centres without stray ones, local frame."""
        return self.centers[~stray_rows(self.centers, self.points)]

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """[3] mean of the training camera centres without stray ones, local frame."""
        return np.asarray(self.robust_centers.mean(axis=0))

    @cached_property
    def distances(self) -> NDArray[np.float64]:
        """[N] distance of each training camera from their mean, local units."""
        return np.asarray(np.linalg.norm(self.centers - self.middle, axis=1))


def centers_of(views: Sequence[View]) -> NDArray[np.float64]:
    """[V, 3] float64 camera centres, local frame."""
    if not views:
        return np.zeros((0, 3))
    return np.stack([view.camera.center.numpy() for view in views]).astype(np.float64)
