"""How well photos agree with points: share of the points in frame, correlation of colours."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene
from crossgrad_core.scene.self_check.rig import Floats, Integers, Rig

#: Observations below which a correlation says nothing.
FEWEST: Final = 8
#: The same for colours of points that other photos show.
FEWEST_OF_PHOTOS: Final = 24
#: Observed points of a photo that are looked at.
MOST_OBSERVED: Final = 64
#: Points of a camera that trials look at.
MOST_TRIED: Final = 2_000
#: Points that are tested for each photo without tracks, at least.
_TESTED: Final = 1_500
#: A point is hidden where another one in its cell is nearer by this factor.
_HIDES: Final = 1.15
#: Points of a cell of the depth test, and the most cells in either direction.
_IN_A_CELL, _CELLS = 6, 64
#: Levels of 255: colours that spread less than this cannot be compared.
FLAT: Final = 4.0

Booleans: TypeAlias = NDArray[np.bool_]
Pixels: TypeAlias = tuple[NDArray[np.uint8], Booleans | None]


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well each photo agrees with the points.

    Attributes:
        share: [V] share of the points that are in front of the camera, in frame and not hidden;
            NaN without any points.
        inside: [V] points whose colours were compared.
        correlation: [V] of the colours of points and photo; NaN where it cannot be told.
        spread: [V] standard deviation of the points' colours, levels of 255.
        stops: [V] how much brighter the photo is than its points, in stops; NaN as above.
    """

    share: Floats
    inside: Integers
    correlation: Floats
    spread: Floats
    stops: Floats

    @property
    def noise(self) -> Floats:
        """[V] standard deviation of the points' colours around those that the photo predicts."""
        return self.spread * np.sqrt(np.maximum(1.0 - np.maximum(self.correlation, 0.0) ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class Evidence:
    """The points that are looked at, and the photos.

    Attributes:
        pixels: Decodes the photo of a view: [H, W, 3] uint8, and [H, W] bool where pixels count.
        rig: The cameras that are looked at.
        rows: [V, N] rows of points for each camera, -1 where there are fewer.
        colors: [P, 3] colours of points; None takes those of the other photos of each point.
        tracked: Whether rows are observations; else points may be hidden or out of frame.
    """

    pixels: Callable[[int], Pixels]
    rig: Rig
    rows: Integers
    colors: NDArray[np.uint8] | None
    tracked: bool

    def chosen(self, cameras: Integers) -> "Evidence":
        """The evidence of some cameras, whose photos are kept in memory from now on."""
        return replace(
            self,
            pixels=cache(self.pixels),
            rig=self.rig.chosen(cameras),
            rows=self.rows[cameras, :MOST_TRIED],
        )

    def of_photos(self) -> "Evidence":
        """The same with the colours of points as the other photos show them."""
        return replace(self, colors=None)

    @property
    def colored(self) -> bool:
        """Whether the colours of the points differ, so that they can be compared."""
        if self.colors is None:
            return True
        return bool(self.colors[np.unique(self.rows[self.rows >= 0])].std(axis=0).max() >= FLAT)

    def agreement(self, rig: Rig) -> Agreement:
        """How well photos agree with the points in a rig, as it is or as a trial changes it."""
        shares, depth, inside = rig.project(self.rows)
        known = self.rows >= 0
        inside &= known
        if not self.tracked:
            inside &= _unhidden(shares, depth, inside)
        counts, framed = known.sum(axis=1), inside.sum(axis=1)
        share = np.divide(framed, counts, out=np.full(len(counts), np.nan), where=counts > 0)
        shown, counting = self._shown(rig.photos, shares, inside)
        inside[inside] = counting
        cameras, columns = np.nonzero(inside)
        rows, shown = self.rows[cameras, columns], shown[counting]
        if self.colors is not None:
            return _compared(share, cameras, shown, self.colors[rows].astype(np.float64))
        times = np.bincount(rows)[rows]
        several = times > 1
        expected = np.stack([np.bincount(rows, each)[rows] for each in shown.T], axis=-1) - shown
        expected /= np.maximum(times - 1, 1)[:, None]
        found = _compared(share, cameras[several], shown[several], expected[several])
        few = found.inside < FEWEST_OF_PHOTOS
        return replace(found, correlation=np.where(few, np.nan, found.correlation))

    def _shown(self, photos: Integers, shares: Floats, inside: Booleans) -> tuple[Floats, Booleans]:
        """[O, 3] colours of the photos where they show the points inside; whether they count."""
        numbers = inside.sum(axis=1)
        places = shares[inside]
        shown = np.empty((len(places), 3))
        counting = np.ones(len(places), dtype=np.bool_)
        end = 0
        for photo, number in zip(photos, numbers, strict=True):
            if not number:
                continue
            part = np.s_[end : end + number]
            end += number
            image, mask = self.pixels(int(photo))
            height, width = image.shape[:2]
            right, down = (places[part] * [width, height]).astype(np.int64).T
            shown[part] = image[down, right]
            if mask is not None:
                counting[part] = mask[down, right]
        return shown, counting


def observed(scene: Scene, views: Integers) -> Evidence:
    """The points that some views observed: of many those that other photos are looked at for, too.

    Args:
        scene: The scene.
        views: Rows of the views.
    """
    rank = np.random.default_rng(0).permutation(len(scene.points))
    rows = np.full((len(views), MOST_OBSERVED), -1)
    for place, view in enumerate(views):
        seen = scene.views[view].seen
        if len(seen) > MOST_OBSERVED:
            first = len(rank) * MOST_OBSERVED / len(seen)
            seen = seen[rank[seen] < first][:MOST_OBSERVED]
        rows[place, : len(seen)] = seen
    return _evidence(scene, views, rows, tracked=True)


def tested(scene: Scene, views: Integers, most: int) -> Evidence:
    """Some points for each of some views without tracks: those in frame that none hides count.

    Args:
        scene: The scene.
        views: Rows of the views.
        most: Points of all views together.
    """
    number, total = max(most // len(views), _TESTED), len(scene.points)
    some = np.random.default_rng(0).choice(total, min(number, total), replace=False)
    rows = np.broadcast_to(some, (len(views), len(some)))
    return _evidence(scene, views, rows, tracked=False)


def _evidence(scene: Scene, views: Integers, rows: Integers, *, tracked: bool) -> Evidence:
    def pixels(view: int) -> Pixels:
        photo = scene.views[view].photo
        mask = photo.mask()
        return photo.image().numpy(), None if mask is None else mask.numpy()

    rig = Rig.of(scene).chosen(views)
    return Evidence(pixels, rig, rows, scene.point_colors, tracked)


def _unhidden(shares: Floats, depth: Floats, inside: Booleans) -> Booleans:
    """[V, N] which points in frame are about the nearest of their cell: a coarse depth buffer."""
    cameras = len(depth)
    cells = np.clip(np.sqrt(inside.sum(axis=1) / _IN_A_CELL), 1, _CELLS).astype(np.int64)
    across, down = (
        np.clip((shares[..., axis] * cells[:, None]).astype(np.int64), 0, cells[:, None] - 1)
        for axis in (0, 1)
    )
    cell = (np.arange(cameras)[:, None] * _CELLS + down) * _CELLS + across
    nearest = np.full(cameras * _CELLS**2, np.inf)
    np.minimum.at(nearest, cell[inside], depth[inside])
    return np.asarray(depth <= _HIDES * nearest[cell])


def _compared(share: Floats, cameras: Integers, shown: Floats, expected: Floats) -> Agreement:
    """The agreement of [O] observations of cameras, by their colours [O, 3]."""
    total = len(share)
    number = np.bincount(cameras, minlength=total)
    divisor = np.maximum(number, 1)

    def summed(values: Floats) -> Floats:
        return np.asarray(np.bincount(cameras, values, total))

    def centered(values: Floats) -> tuple[Floats, Floats]:
        means = np.stack([summed(channel) for channel in values.T], axis=-1) / divisor[:, None]
        return means.mean(axis=1), values - means[cameras]

    (light, off), (light_expected, off_expected) = centered(shown), centered(expected)
    squares = summed((off**2).sum(axis=1)), summed((off_expected**2).sum(axis=1))
    spread = [np.sqrt(each / (3.0 * divisor)) for each in squares]
    told = (number >= FEWEST) & (np.minimum(*spread) >= FLAT)
    product = summed((off * off_expected).sum(axis=1))
    correlation = np.full(total, np.nan)
    correlation[told] = product[told] / np.sqrt(squares[0][told] * squares[1][told])
    stops = np.where(told, 2.2 * np.log2((light + 1.0) / (light_expected + 1.0)), np.nan)
    return Agreement(share, number, correlation, np.asarray(spread[1]), stops)
