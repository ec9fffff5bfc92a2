"""Count correct and wrong pairs among the verified pairs of `crossgrad prepare`.

    python benchmarks/prepare_pairs.py PHOTOS SCENE --truth MODEL [--truth MODEL ...] [--map]

For each pair of folders, the table counts photo pairs with verified matches, and wrong photo pairs,
by number of matches. A pair is wrong if fewer than half of its matches are within four pixels of
the epipolar lines of the true poses. With `--map`, poses are estimated again from only the correct
pairs, at COLMAP's thresholds and at half of each threshold. The result is an upper bound for any
method that selects pairs.
"""

import argparse
import itertools
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from _machine import code, facts
from numpy.typing import NDArray
from prepare import CLOSE, Poses, errors_of, poses_of

#: Minimum number of matches for each column of the table.
BOUNDS = (15, 20, 30, 60, 100)
#: Maximum distance in pixels between a match and its epipolar line, and minimum share of matches
#: within this distance.
NEAR, RIGHT = 4.0, 0.5
#: Thresholds for a pose: first COLMAP's values, then half of each value. The thresholds are a
#: number of points and a share of the tested points.
THRESHOLDS = ((30, 0.25), (15, 0.125))

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """A pair with verified matches.

    Attributes:
        numbers: Numbers of the two photos in the database.
        names: Names of the two photos.
        matches: Number of verified matches.
        right: True if most of these matches agree with the true poses.
    """

    numbers: tuple[int, int]
    names: tuple[str, str]
    matches: int
    right: bool

    @property
    def folders(self) -> str:
        """The two folders, sorted by name."""
        return " - ".join(sorted(name.rpartition("/")[0] for name in self.names))


def intrinsics_of(folders: list[Path]) -> dict[str, Matrix]:
    """Return the matrix K [3, 3] for each name, of all models."""
    models = [pycolmap.Reconstruction(folder) for folder in folders]
    return {
        image.name: model.camera(image.camera_id).calibration_matrix()
        for model in models
        for image in model.images.values()
    }


def judged(path: Path, truth: Poses, intrinsics: dict[str, Matrix]) -> Iterator[Pair]:
    """Yield the verified pairs of a database whose two photos have true poses."""
    database = pycolmap.Database.open(path)
    names = {image.image_id: image.name for image in database.read_all_images()}
    for pair, found in zip(*database.read_two_view_geometries(), strict=True):
        matches = np.asarray(found.inlier_matches)
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if not len(matches) or not {names[first], names[second]} <= truth.keys():
            continue
        one, other = (
            homogeneous(database.read_keypoints(n)[matches[:, side], :2])
            for side, n in enumerate((first, second))
        )
        matrix = fundamental(truth, intrinsics, names[first], names[second])
        lines, back = one @ matrix.T, other @ matrix
        off = np.abs((other * lines).sum(axis=1))
        off /= np.minimum(np.hypot(*lines[:, :2].T), np.hypot(*back[:, :2].T))
        right = bool((off < NEAR).mean() >= RIGHT)
        yield Pair((first, second), (names[first], names[second]), len(matches), right)
    database.close()


def homogeneous(pixels: NDArray[np.float32]) -> Matrix:
    """Return pixels [N, 3] in homogeneous coordinates."""
    return np.column_stack([np.asarray(pixels, np.float64), np.ones(len(pixels))])


def fundamental(truth: Poses, intrinsics: dict[str, Matrix], first: str, second: str) -> Matrix:
    """Return the fundamental matrix [3, 3], from a pixel in `first` to its line in `second`."""
    turn = truth[second][0] @ truth[first][0].T
    x, y, z = truth[second][0] @ (truth[first][1] - truth[second][1])
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    left, right = np.linalg.inv(intrinsics[second]).T, np.linalg.inv(intrinsics[first])
    return np.asarray(left @ cross @ turn @ right)


def table(pairs: list[Pair]) -> Iterator[str]:
    """Yield a table of the numbers of pairs and of wrong pairs.

    Each row is a pair of folders. Each column is a range of the number of matches.
    """
    titles = [f"{low} to {high - 1}" for low, high in itertools.pairwise(BOUNDS)]
    titles.append(f"{BOUNDS[-1]} and more")
    yield "| folders | " + " | ".join(titles) + " |"
    yield "|---" * (len(BOUNDS) + 1) + "|"
    columns = np.searchsorted(BOUNDS, [pair.matches for pair in pairs], side="right") - 1
    counts = Counter(
        (pair.folders, int(column), pair.right) for pair, column in zip(pairs, columns, strict=True)
    )
    for folders in sorted({pair.folders for pair in pairs}):
        cells = []
        for column in range(len(BOUNDS)):
            wrong, right = counts[folders, column, False], counts[folders, column, True]
            cells.append(f"{wrong + right}, {wrong} wrong" if wrong else str(right))
        yield f"| {folders} | " + " | ".join(cells) + " |"


def mapped(photos: Path, source: Path, wrong: list[Pair], truth: Poses) -> Iterator[str]:
    """Yield the mapping results from only the correct pairs, for each pair of thresholds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        shutil.copy(source, path)
        database = pycolmap.Database.open(path)
        for pair in wrong:
            database.delete_inlier_matches(*pair.numbers)
        database.close()
        for points, share in THRESHOLDS:
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads, options.random_seed = 2, 0
            options.mapper.abs_pose_min_num_inliers = points
            options.mapper.abs_pose_min_inlier_ratio = share
            out = Path(folder) / str(points)
            out.mkdir()
            models = pycolmap.incremental_mapping(path, photos, out, options=options)
            if not models:
                yield f"with the right pairs alone and {points} points for a pose: nothing"
                continue
            largest = max(models.values(), key=lambda model: model.num_reg_images())
            largest.write(out)
            errors, _ = errors_of(poses_of([out]), truth)
            close = sum(distance <= CLOSE for distance, _ in errors.values())
            yield (
                f"with the right pairs alone, {points} points and {share:.1%} of those tried for a "
                f"pose: {len(errors)} registered, {close} within {CLOSE:.1%}"
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", type=Path, action="append", required=True)
    parser.add_argument(
        "--map", action="store_true", help="also find the cameras from only the correct pairs"
    )
    given = parser.parse_args()
    truth, path = poses_of(given.truth), given.scene / "prepare" / "database.db"
    pairs = list(judged(path, truth, intrinsics_of(given.truth)))
    print("\n".join(table(pairs)))
    if given.map:
        wrong = [pair for pair in pairs if not pair.right]
        for line in mapped(given.photos, path, wrong, truth):
            print(line, flush=True)
    machine = facts()
    print(f"\n{code()}, {machine['cpu']}, {machine['date']}, pycolmap {pycolmap.__version__}")


if __name__ == "__main__":
    main()
