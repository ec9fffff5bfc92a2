"""Search for photos whose matches contradict their poses in a model."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.prepare.pose_from_pairs import Rays, off_lines
from crossgrad_plugins.prepare.pycolmap_calls import quiet

if TYPE_CHECKING:
    import pycolmap

#: A pair of photos counts if it has at least this many verified matches. COLMAP requires the same
#: number of matches for a pose. With fewer matches, most pairs of photos that show repeated walls
#: or pavements are wrong.
_MATCHES: Final = 30
#: Maximum distance in pixels between a match and its epipolar line, as in COLMAP's verification.
#: Two poses agree with a pair of photos if at least this share of the pair's matches is within the
#: distance.
_PIXELS, _AGREEING = 4.0, 0.5
#: A photo is misplaced if two conditions hold: less than this share of its matches agrees, and at
#: least this many of its pairs disagree. A single pair is not enough, because one pair can be
#: wrong.
_SHARE, _AGAINST = 1.0 / 3.0, 2


@dataclass(frozen=True, eq=False)
class Votes:
    """The pairs of a model, with a flag for pairs that agree with the model's poses.

    Attributes:
        photos: [P, 2] numbers of the photos of each pair.
        matches: [P] number of verified matches.
        agrees: [P] True if most of the matches agree with the two poses.
    """

    photos: NDArray[np.int64]
    matches: NDArray[np.int64]
    agrees: NDArray[np.bool_]


def contradicted(
    model: "pycolmap.Reconstruction", database: Path, settled: Collection[int] = ()
) -> dict[int, tuple[int, int]]:
    """Return the photos whose matches with other photos contradict their poses.

    Repeated structures at different places look alike. Pairs of photos of such places pass COLMAP's
    verification of two views. They can misplace a photo that is added early. Pairs with photos that
    are added later show this error. The photo with the smallest share of agreeing matches is
    removed first. Its matches then no longer count for other photos.

    Args:
        model: The model after mapping.
        database: COLMAP's database with the verified matches.
        settled: Photos for which no other pose has more agreeing matches; these photos are never
            returned.

    Returns:
        Number of each misplaced photo -> number of its matches for and against its pose.
    """
    votes, misplaced = _votes(model, database), dict[int, tuple[int, int]]()
    counts = _Counts(max(model.reg_image_ids(), default=0) + 1)
    present = np.ones(len(votes.matches), dtype=np.bool_)
    while present.any():
        yes, no = (counts.of(votes, present & side) for side in (votes.agrees, ~votes.agrees))
        weighed = np.where(no[1] >= _AGAINST, yes[0] / np.maximum(1, yes[0] + no[0]), 1.0)
        weighed[list(settled)] = 1.0
        worst = int(np.argmin(weighed))
        if weighed[worst] >= _SHARE:
            break
        misplaced[worst] = int(yes[0][worst]), int(no[0][worst])
        present &= (votes.photos != worst).all(axis=1)
    return misplaced


@dataclass(frozen=True)
class _Counts:
    """Sums over pairs of photos, for each photo.

    Attributes:
        size: Largest number of a photo plus one.
    """

    size: int

    def of(
        self, votes: Votes, which: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return for each photo its number of matches [size] and of pairs [size]."""
        photos, matches = votes.photos[which].ravel(), np.repeat(votes.matches[which], 2)
        summed = np.bincount(photos, matches.astype(np.float64), minlength=self.size)
        return summed.astype(np.float64), np.bincount(photos, minlength=self.size).astype(np.int64)


def _votes(model: "pycolmap.Reconstruction", path: Path) -> Votes:
    import pycolmap

    with quiet():
        database = pycolmap.Database.open(path)
        try:
            rows = list(_judged(model, database))
        finally:
            database.close()
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return Votes(table[:, :2], table[:, 2], table[:, 3] >= _AGREEING * table[:, 2])


def _judged(
    model: "pycolmap.Reconstruction", database: "pycolmap.Database"
) -> Iterator[tuple[int, int, int, int]]:
    """Yield for each pair the numbers of both photos, of all matches and of agreeing matches.

    Only pairs of photos in the model are returned.
    """
    import pycolmap

    poses = {number: model.image(number).cam_from_world() for number in model.reg_image_ids()}
    rays = Rays(dict(model.cameras.items()), database)
    pairs, counts = database.read_two_view_geometry_num_inliers()
    for pair, count in zip(pairs, counts, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if count < _MATCHES or first not in poses or second not in poses:
            continue
        matches = np.asarray(database.read_two_view_geometry(first, second).inlier_matches)
        off = off_lines(
            (poses[first], poses[second]),
            (rays.of(first)[matches[:, 0]], rays.of(second)[matches[:, 1]]),
            (rays.focal(first), rays.focal(second)),
        )
        yield first, second, len(matches), int((off <= _PIXELS).sum())
