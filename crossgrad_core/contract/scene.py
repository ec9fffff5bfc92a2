"""The data types of a scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.georeference import UNPLACED, Georeference, Similarity

#: Minimum number of cameras for a search for stray cameras.
_FEWEST: Final = 5
#: Maximum share of stray cameras. One stray camera is always allowed.
_MOST: Final = 0.1
#: A camera is stray if its distance from the median camera centre exceeds the distances of all
#: other cameras and of most points by this factor.
_FAR: Final = 10.0
#: Quantile of the points' distances. The quantile is used instead of the maximum, because single
#: points may also be stray.
_OF_POINTS: Final = 0.9


def stray_rows(centers: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return [N], True for cameras ten times farther from the scene than other cameras and points.

    A far camera is not an outlier if the points extend as far, because the points show the size of
    the scene.

    Args:
        centers: [N, 3] camera centres.
        points: [P, 3] SfM points in the same frame; may be empty.
    """
    none = np.zeros(len(centers), dtype=np.bool_)
    if len(centers) < _FEWEST:
        return none
    middle = np.median(centers, axis=0)
    away = np.linalg.norm(centers - middle, axis=1)
    most = max(1, int(_MOST * len(centers)))
    order = np.argsort(away)
    # The widest gap among the farthest cameras separates stray cameras from the other cameras.
    ratios = away[order][-most:] / np.maximum(away[order][-most - 1 : -1], np.finfo(float).tiny)
    first = len(centers) - most + int(ratios.argmax())
    reach = away[order[first - 1]]
    if ratios.max() <= _FAR or reach == 0.0:
        return none
    if len(points):
        ways = np.linalg.norm(points - middle, axis=1)
        reach = max(reach, float(np.quantile(ways, _OF_POINTS)))
    none[order[first:]] = away[order[first:]] > _FAR * reach
    return none


@dataclass(frozen=True, eq=False)
class Pinhole:
    """An undistorted calibration in pixels; pixel centres are at +0.5.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Horizontal focal length in pixels.
        fy: Vertical focal length in pixels.
        cx: Distance of the principal point from the left image border in pixels.
        cy: Distance of the principal point from the top image border in pixels.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> Self:
        """Return the same calibration for an image resampled to `width` x `height`."""
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
        """Return points [N, 3] of the local frame in camera coordinates; column 2 is the depth."""
        pose = self.world_to_camera.numpy()
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def project(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return pixels [N, 2] (x right, y down) and depths [N] of points [N, 3] (local frame).

        Pixels of points that are not in front of the camera are finite, but have no meaning.
        """
        x, y, depth = self.local(points).T
        inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
        across, down = self.fx * x * inverse, self.fy * y * inverse
        return np.column_stack([across + self.cx, down + self.cy]), depth


class Photo(Protocol):
    """A photo that is decoded on request."""

    def image(self) -> Tensor:
        """Return [H, W, 3] uint8, RGB, in the size of the view's camera."""
        ...

    def mask(self) -> Tensor | None:
        """Return [H, W] bool, True where the pixel counts; None if every pixel counts."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """A camera with its photo, its unique name (the path below the image folder) and its regime.

    Attributes:
        name: Path relative to the image folder with forward slashes.
        camera: The camera, for the photo at training resolution.
        photo: The photo, decoded on request.
        regime: Label of the camera group under which results are reported.
        seen: [S] int64 indices of the SfM points that this view observed; may be empty.
    """

    name: str
    camera: Camera
    photo: Photo
    regime: str
    seen: NDArray[np.int64]


#: Weight of the cameras' mean up axis, compared with the mean square of their horizontal axes.
_LEVEL: Final = 1e-3


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: its views, points and coordinate frames.

    Attributes:
        name: Short name, used for the output folder.
        views: All views, sorted by name.
        train: Positions of the training views in `views`.
        test: Positions of the held-out views in `views`.
        points: [P, 3] float64 SfM points, local frame.
        point_colors: [P, 3] uint8 RGB.
        similarity: Maps the local frame back to the input frame.
        notes: Changes to the input, with reasons (undistorted, resized, images left out ...).
        point_sizes: [P] standard deviations of the initial Gaussians, local units; NaN if the size
            is computed from the distance to the neighbours. None means NaN at all points.
        point_opacities: [P] opacities of the initial Gaussians; NaN if the backbone computes the
            opacity. None means NaN at all points.
        georeference: Location of the scene on Earth.
        files: Files that the scene was read from, except photos and masks.
        check: Results of the consistency check of the scene; None before the check.
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
        """Return the scene with only the points in `rows` [Q] (ascending); `seen` is updated."""
        new_rows = np.full(len(self.points), -1)
        new_rows[rows] = np.arange(len(rows))

        def left(view: View) -> View:
            seen = new_rows[view.seen]
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
        """The training views, in the order of the indices that samplers use."""
        return tuple(self.views[i] for i in self.train)

    @cached_property
    def train_pixels(self) -> float:
        """Mean number of pixels of a training photo; 0 without training photos."""
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
        """[M, 3] training camera centres without outliers, local frame."""
        return self.centers[~stray_rows(self.centers, self.points)]

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """[3] mean of the training camera centres without outliers, local frame."""
        return np.asarray(self.robust_centers.mean(axis=0))

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """[3] unit vector that points up, local frame, by the georeference or by the cameras.

        People hold cameras level, so that the horizontal axis of a photo is perpendicular to up.
        The vector is perpendicular to these axes as far as they span a plane. In all other
        directions it is the mean of the cameras' up axes, tilted back by half of the viewing
        direction for cameras that look down.
        """
        if self.georeference.up is not None:
            return self.georeference.up
        poses = np.stack([view.camera.world_to_camera.numpy() for view in self.train_views])
        right, down, forward = poses[:, :3, :3].transpose(1, 0, 2)
        level = right.T @ right / len(right) + _LEVEL * np.eye(3)
        up = np.linalg.solve(level, (-down - 0.5 * forward).mean(axis=0))
        return np.asarray(up / np.linalg.norm(up))

    @cached_property
    def distances(self) -> NDArray[np.float64]:
        """[N] distance of each training camera from the mean camera centre, local units."""
        return np.asarray(np.linalg.norm(self.centers - self.middle, axis=1))


def centers_of(views: Sequence[View]) -> NDArray[np.float64]:
    """Return [V, 3] float64 camera centres, local frame."""
    if not views:
        return np.zeros((0, 3))
    return np.stack([view.camera.center.numpy() for view in views]).astype(np.float64)


#: If a view observed fewer points than this number, the median over all points in its image is used
#: instead.
_FEWEST_SEEN = 3
#: Maximum number of points that are tested against the image of a view that observed too few
#: points.
_MOST_TESTED = 50_000
#: Number of significant bits of a distance between cameras. The remaining bits are rounding errors.
_BITS = 40
#: Relative rounding error of an input coordinate and of a few sums of coordinates.
_ROUNDED = 16 * float(np.finfo(np.float64).eps)


def radial_distances(scene: Scene, views: Sequence[View]) -> NDArray[np.float64]:
    """Return [V], the distance of each camera from the mean training camera centre, local units.

    Rounding errors are removed. A camera at the mean centre gets the distance 0. Distances that
    differ only by rounding errors become equal.
    """
    return without_rounding(scene, np.linalg.norm(centers_of(views) - scene.middle, axis=1))


def without_rounding(scene: Scene, lengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return lengths [V] between camera centres, rounded to 2^-40 of the largest coordinate.

    In regular camera layouts, equal distances differ by the rounding error of the mean camera
    centre. A threshold at the median, a rank or a logarithm would depend on this rounding error. If
    the rounding error of the scene's input coordinates is larger than 2^-40 of the largest
    coordinate, the lengths are rounded to this rounding error.
    """
    largest = float(np.abs(scene.centers).max(initial=0.0))
    given = float(np.abs(scene.similarity.to_input(scene.centers)).max(initial=0.0))
    least = max(largest * 2.0**-_BITS, given * scene.similarity.scale * _ROUNDED)
    if not 0.0 < least < np.inf:
        return lengths
    step = 2.0 ** np.ceil(np.log2(least))
    return np.asarray(np.round(lengths / step) * step)


def footprint_of(scene: Scene, view: View) -> float:
    """Return the pixels per local unit at the points that a view observed; see `footprint`."""
    return footprint(view.camera, scene.points, view.seen)


def footprint(camera: Camera, points: NDArray[np.float64], seen: NDArray[np.int64]) -> float:
    """Return the median of f / z [pixels per local unit] over a camera's observed SfM points.

    Here f is the focal length and z the depth of a point. If the camera observed fewer than 3
    points in front of it, all points in its image are used instead. If no point is in the image,
    the observed points are used. Without any point, the result is NaN.

    Args:
        camera: The camera, for the photo at training resolution.
        points: [P, 3] SfM points, local frame.
        seen: Rows of `points` that the camera observed.
    """
    depths = _in_front(camera, points[seen])[:, 2]
    if len(depths) < _FEWEST_SEEN:
        tested = points[:: max(1, len(points) // _MOST_TESTED)]
        inside = camera.local(tested[is_in_image(camera, tested)])[:, 2]
        depths = inside if len(inside) else depths
    if not len(depths):
        return float("nan")
    return float(np.sqrt(camera.fx * camera.fy) / np.median(depths))


def _in_front(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    local = camera.local(points)
    return local[local[:, 2] > 0.0]


def is_in_image(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return [P], True for points [P, 3] (local frame) in a camera's image; ignore occlusion."""
    local = camera.local(points)
    front = local[:, 2] > 0.0
    depth = np.where(front, local[:, 2], 1.0)
    x, y = camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy
    return np.asarray(front & (x >= 0.0) & (x < camera.width) & (y >= 0.0) & (y < camera.height))


def masked(image: Tensor, mask: Tensor | None) -> Tensor:
    """Return the image [H, W, C] with 0 at masked-out pixels; a NaN there is replaced, too."""
    if mask is None:
        return image
    return torch.where(mask.unsqueeze(-1), image, image.new_zeros(()))


def unit_range(image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the image in `dtype`; 8-bit values are divided by 255."""
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)


def to_uint8(image: Tensor) -> Tensor:
    """Return the image as uint8 on the CPU, clamped to [0, 1] and rounded; NaN becomes 0."""
    image = image.detach().cpu()
    if image.dtype == torch.uint8:
        return image
    return (torch.nan_to_num(image, nan=0.0).clamp(0, 1) * 255).round().to(torch.uint8)
