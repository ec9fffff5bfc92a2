"""Measure how well photos agree with points: points inside the photo, and colour correlation.

Cameras and points are stored as arrays in input coordinates, so that trials can change them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
#: Orientation of photos that are neither rotated nor mirrored.
UPRIGHT: Final = np.eye(2)
#: With fewer observations than this number, no correlation is computed.
FEWEST: Final = 8
#: Minimum number of observations if the colours of points are taken from other photos.
FEWEST_OF_PHOTOS: Final = 24
#: Largest number of observed points for each photo.
MOST_OBSERVED: Final = 64
#: Largest number of points for each camera in trials.
MOST_TRIED: Final = 2_000
#: Minimum number of points that are tested in each photo if the views have no tracks.
_TESTED: Final = 1_500
#: A point is hidden if another point in its image cell is nearer by at least this factor.
_HIDES: Final = 1.15
#: The depth test divides a photo into cells. `_IN_A_CELL`: mean number of points in a cell.
#: `_CELLS`: largest number of cells along each image side.
_IN_A_CELL, _CELLS = 6, 64
#: Colours cannot be compared if their standard deviation is below this number of levels of 255.
FLAT: Final = 4.0
Booleans: TypeAlias = NDArray[np.bool_]
Photo: TypeAlias = tuple[NDArray[np.uint8], Booleans | None]
#: Function that decodes the photo of a view. The function returns the pixels [H, W, 3] uint8 and,
#: if some pixels are masked, the mask [H, W] bool.
Pixels: TypeAlias = Callable[[int], Photo]


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras and the points of a scene.

    Attributes:
        rotations: [V, 3, 3] rotations from world to camera.
        translations: [V, 3] translations from world to camera, in input units.
        focal: [V, 2] focal lengths in pixels.
        principal: [V, 2] principal points in pixels.
        sizes: [V, 2] widths and heights of the photos in pixels.
        points: [P, 3] points in input units.
        photos: [V] index of the view whose photo is compared with each camera.
        count: Number of photos in the scene.
        turn: [2, 2] matrix that rotates or mirrors all photos about their centres.
    """

    rotations: Floats
    translations: Floats
    focal: Floats
    principal: Floats
    sizes: Floats
    points: Floats
    photos: Integers
    count: int
    turn: Floats

    @classmethod
    def of(cls, scene: Scene) -> "Rig":
        """Create the rig of a scene."""
        cameras = [view.camera for view in scene.views]
        poses = np.stack([camera.world_to_camera.numpy() for camera in cameras])
        rotations = poses[:, :3, :3]
        centers = scene.similarity.to_input(-np.einsum("vji,vj->vi", rotations, poses[:, :3, 3]))
        return cls(
            rotations=rotations,
            translations=-np.einsum("vij,vj->vi", rotations, centers),
            focal=np.array([[camera.fx, camera.fy] for camera in cameras]),
            principal=np.array([[camera.cx, camera.cy] for camera in cameras]),
            sizes=np.array([[camera.width, camera.height] for camera in cameras], dtype=np.float64),
            points=scene.similarity.to_input(scene.points),
            photos=np.arange(len(cameras)),
            count=len(cameras),
            turn=UPRIGHT,
        )

    def chosen(self, views: Sequence[int] | Integers) -> "Rig":
        """Return a rig that contains only some of the cameras.

        Each camera is still compared with its photo.
        """
        rows = np.asarray(views, dtype=np.int64)
        return replace(
            self,
            rotations=self.rotations[rows],
            translations=self.translations[rows],
            focal=self.focal[rows],
            principal=self.principal[rows],
            sizes=self.sizes[rows],
            photos=self.photos[rows],
        )

    def joined(self, others: Sequence["Rig"]) -> "Rig":
        """Return a rig with the cameras of this rig and of other rigs.

        All rigs must contain equal points.
        """
        rigs = (self, *others)
        return replace(
            self,
            rotations=np.concatenate([rig.rotations for rig in rigs]),
            translations=np.concatenate([rig.translations for rig in rigs]),
            focal=np.concatenate([rig.focal for rig in rigs]),
            principal=np.concatenate([rig.principal for rig in rigs]),
            sizes=np.concatenate([rig.sizes for rig in rigs]),
            photos=np.concatenate([rig.photos for rig in rigs]),
        )

    @property
    def centers(self) -> Floats:
        """Camera centres [V, 3] in input units."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotations, self.translations))

    def project(self, rows: Integers) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Project points into all cameras.

        Args:
            rows: [V, N] rows of the points that are projected into each camera.

        Returns:
            [2, V, N] positions in the photo as shares of its width and height, [V, N] depths, and a
            mask [V, N]. The mask is True for points in front of the camera and inside the photo.
        """
        local = self.rotations @ self.points.take(rows, axis=0).transpose(0, 2, 1)
        x, y, depth = local.transpose(1, 0, 2) + self.translations.T[:, :, None]
        front = depth > 0.0
        inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=front)
        focal, principal = (
            (intrinsic / self.sizes).T[:, :, None] for intrinsic in (self.focal, self.principal)
        )
        across, down = shares = focal * np.stack([x * inverse, y * inverse]) + principal
        inside = front & (across >= 0.0) & (across < 1.0) & (down >= 0.0) & (down < 1.0)
        if self.turn is not UPRIGHT:
            shares = np.tensordot(self.turn, shares - 0.5, axes=1) + 0.5
        return shares, depth, inside


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well each photo agrees with the points.

    Attributes:
        share: [V] share of the points that are in front of the camera, inside the photo and not
            hidden. NaN without points.
        inside: [V] number of points whose colours were compared with the photo.
        correlation: [V] correlation between the colours of points and photo; NaN if undefined.
        spread: [V] standard deviation of the points' colours, in levels of 255.
    """

    share: Floats
    inside: Integers
    correlation: Floats
    spread: Floats

    @property
    def noise(self) -> Floats:
        """[V] standard deviation of the points' colours from the colours predicted by the photo."""
        return self.spread * np.sqrt(np.maximum(1.0 - np.maximum(self.correlation, 0.0) ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class Evidence:
    """The cameras, points and photos that the check compares.

    Attributes:
        pixels: Function that decodes the photo of a view.
        rig: The cameras and points.
        rows: [V, N] rows of the points that are compared in each camera, padded with -1.
        colors: [P, 3] colours of the points. If `colors` is None, each point has the mean colour
            that other photos show.
        tracked: True if `rows` contains observations. If `tracked` is False, points may be hidden
            or outside the photo.
    """

    pixels: Pixels
    rig: Rig
    rows: Integers
    colors: NDArray[np.uint8] | None
    tracked: bool

    def chosen(self, cameras: Integers) -> "Evidence":
        """Return the evidence for some of the cameras."""
        rows = self.rows[cameras, :MOST_TRIED]
        return replace(self, rig=self.rig.chosen(cameras), rows=rows)

    def of_photos(self) -> "Evidence":
        """Return the evidence with colours of the points from other photos."""
        return replace(self, colors=None)

    def sees_nothing(self, cameras: Integers) -> Booleans:
        """Return a mask of `cameras`.

        The mask is True if none of the scene's points is inside the photo.
        """
        rows = np.broadcast_to(np.arange(len(self.rig.points)), (1, len(self.rig.points)))
        return np.array(
            [not self.rig.chosen([camera]).project(rows)[2].any() for camera in cameras], dtype=bool
        )

    @property
    def colored(self) -> bool:
        """True if the colours of the points differ enough for a comparison."""
        if self.colors is None:
            return True
        return bool(self.colors[np.unique(self.rows[self.rows >= 0])].std(axis=0).max() >= FLAT)

    def agreement(self, rig: Rig) -> Agreement:
        """Measure how well photos and points agree in a rig. A trial may have changed the rig."""
        shares, depth, inside = rig.project(self.rows)
        is_listed = self.rows >= 0
        inside &= is_listed
        if not self.tracked:
            inside &= _unhidden(shares, depth, inside)
        counts, framed = is_listed.sum(axis=1), inside.sum(axis=1)
        share = np.divide(framed, counts, out=np.full(len(counts), np.nan), where=counts > 0)
        shown = self._shown(rig.photos, shares, inside)
        if self.colors is not None:
            expected = self.colors.take(self.rows, axis=0).astype(np.float64)
            return _compared(share, inside, shown, expected)
        rows = self.rows[inside]
        times = np.bincount(rows)[rows]
        sums = np.stack([np.bincount(rows, channel)[rows] for channel in shown[inside].T], axis=-1)
        expected = np.zeros_like(shown)
        expected[inside] = (sums - shown[inside]) / np.maximum(times - 1, 1)[:, None]
        inside[inside] = times > 1
        agreement = _compared(share, inside, shown, expected)
        few = agreement.inside < FEWEST_OF_PHOTOS
        return replace(agreement, correlation=np.where(few, np.nan, agreement.correlation))

    def _shown(self, photos: Integers, shares: Floats, inside: Booleans) -> Floats:
        """Return the photos' colours [V, N, 3] at the points.

        `inside` becomes False for masked pixels.
        """
        photo_of = np.repeat(photos, inside.sum(axis=1))
        order = np.argsort(photo_of, kind="stable")
        at = np.flatnonzero(inside)[order]
        across, down = shares.reshape(2, -1).take(at, axis=1)
        several, starts = np.unique(photo_of[order], return_index=True)
        ends = np.append(starts, len(at))[1:]
        shown = np.zeros((inside.size, 3))
        for photo, start, end in zip(several.tolist(), starts, ends, strict=True):
            image, mask = self.pixels(photo)
            height, width = image.shape[:2]
            rows = (down[start:end] * height).astype(np.int64)
            pixels = rows * width + (across[start:end] * width).astype(np.int64)
            shown[at[start:end]] = image.reshape(-1, 3).take(pixels, axis=0)
            if mask is not None:
                inside.flat[at[start:end]] = mask.reshape(-1).take(pixels)
        return shown.reshape(*inside.shape, 3)


def pixels_of(scene: Scene) -> Pixels:
    """Return a function that decodes and caches the photos of a scene."""

    @cache
    def decoded(view: int) -> Photo:
        photo = scene.views[view].photo
        mask = photo.mask()
        return photo.image().numpy(), None if mask is None else mask.numpy()

    return decoded


def observed(scene: Scene, views: Integers, pixels: Pixels) -> Evidence:
    """Collect observed points for some views.

    Points that several of the views observe are preferred.

    Args:
        scene: The scene.
        views: Indices of the views in the scene.
        pixels: Function that decodes the photo of a view.
    """
    rank = np.random.default_rng(0).permutation(len(scene.points))
    rows = np.full((len(views), MOST_OBSERVED), -1)
    for row, view in enumerate(views):
        seen = scene.views[view].seen
        if len(seen) > MOST_OBSERVED:
            first = len(rank) * MOST_OBSERVED / len(seen)
            seen = seen.take(np.flatnonzero(rank.take(seen) < first)[:MOST_OBSERVED])
        rows[row, : len(seen)] = seen
    return Evidence(pixels, Rig.of(scene).chosen(views), rows, scene.point_colors, tracked=True)


def tested(scene: Scene, views: Integers, pixels: Pixels, most: int) -> Evidence:
    """Collect random points for views without tracks. A later depth test removes hidden points.

    Args:
        scene: The scene.
        views: Indices of the views in the scene.
        pixels: Function that decodes the photo of a view.
        most: Largest number of points, summed over all views.
    """
    number, total = max(most // len(views), _TESTED), len(scene.points)
    sample = np.random.default_rng(0).choice(total, min(number, total), replace=False)
    rows = np.broadcast_to(sample, (len(views), len(sample)))
    return Evidence(pixels, Rig.of(scene).chosen(views), rows, scene.point_colors, tracked=False)


def _unhidden(shares: Floats, depth: Floats, inside: Booleans) -> Booleans:
    """Return a mask [V, N] of the points that no nearer point in their image cell hides."""
    cameras = len(depth)
    cells = np.clip(np.sqrt(inside.sum(axis=1) / _IN_A_CELL), 1, _CELLS).astype(np.int64)
    across, down = (
        np.clip((share * cells[:, None]).astype(np.int64), 0, cells[:, None] - 1)
        for share in shares
    )
    cell = (np.arange(cameras)[:, None] * _CELLS + down) * _CELLS + across
    nearest = np.full(cameras * _CELLS**2, np.inf)
    np.minimum.at(nearest, cell[inside], depth[inside])
    return np.asarray(depth <= _HIDES * nearest[cell])


def _compared(share: Floats, inside: Booleans, shown: Floats, expected: Floats) -> Agreement:
    """Return the agreement of photos and points, from the colours of the points in each photo.

    Args:
        share: [V] share of the points that is inside the photo.
        inside: [V, N] mask of the points whose colours are compared.
        shown: [V, N, 3] colours of the photos at the points.
        expected: [V, N, 3] colours of the points.
    """
    number = inside.sum(axis=1)
    divisor = np.maximum(number, 1)

    def centered(colors: Floats) -> Floats:
        colors = colors * inside[..., None]
        means = np.einsum("vnc->vc", colors) / divisor[:, None]
        return np.asarray((colors - means[:, None]) * inside[..., None])

    def products(first: Floats, second: Floats) -> Floats:
        return np.asarray(np.einsum("vnc,vnc->v", first, second))

    off, off_expected = centered(shown), centered(expected)
    squares = products(off, off), products(off_expected, off_expected)
    spread = [np.sqrt(square_sums / (3.0 * divisor)) for square_sums in squares]
    comparable = (number >= FEWEST) & (np.minimum(*spread) >= FLAT)
    correlation = np.full(len(number), np.nan)
    product = products(off, off_expected)
    correlation[comparable] = product[comparable] / np.sqrt(
        squares[0][comparable] * squares[1][comparable]
    )
    return Agreement(share, number, correlation, spread[1])
