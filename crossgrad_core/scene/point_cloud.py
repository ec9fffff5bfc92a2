"""Read point clouds from PLY, LAS or LAZ files, and reduce them to the density of SfM points.

LAS and LAZ files, which laser scanners write, can be read if the package laspy is installed.

Source of the format: ASPRS, LAS specification 1.4. A position is an integer times a scale plus an
offset, both from the header. laspy computes positions in float64.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.raw import CheckedPoints
from crossgrad_core.system.input_files import open_file
from crossgrad_core.system.ply_table import read_vertices

if TYPE_CHECKING:
    import laspy


#: Suffixes of LAS and LAZ files.
SUFFIXES: Final = (".las", ".laz")
#: Suffixes of all point cloud files.
CLOUDS: Final = (".ply", *SUFFIXES)
_GREY: Final = 127
#: Colours have 16 bits if the `_MOST` percentile of their values is at least `_LONG`.
_MOST: Final = 99.0
_LONG: Final = 512.0
_COLORS: Final = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
#: PLY properties that only Gaussians have.
_GAUSSIAN: Final = frozenset({"f_dc_0", "opacity", "scale_0", "rot_0"})
_RGB: Final = ("red", "green", "blue")
_AT_ONCE: Final = 1_000_000
#: Maximum number of points that are read from a file. If the file contains more points, only every
#: n-th point is read.
_MOST_IN_LAS: Final = 20_000_000
#: Default number of points: at least `FEWEST`, and `PER_PHOTO` for each photo. Structure from
#: motion finds a few hundred points for each photo.
FEWEST: Final = 100_000
PER_PHOTO: Final = 1_000
#: Maximum number of cube sizes that are tried. The search ends early if the result contains at
#: least this share of the wanted number of points.
_TRIES, _ENOUGH = 12, 0.8
#: Number of points in the sample from which the size of a cloud is estimated.
_SAMPLED: Final = 100_000
#: Most points are on surfaces. The number of occupied cubes is therefore proportional to 1 /
#: side^2.
_SURFACE: Final = 2.0
#: Odd factors of a hash function for the integer coordinates of cubes.
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
_FARTHEST: Final = 2.0**62
#: Side of the cubes in input units if all points are at one position.
_SMALLEST: Final = 1e-12


@dataclass(frozen=True, eq=False)
class PointCloud:
    """The points of a file with their colours.

    Attributes:
        positions: [P, 3] float64.
        colors: [P, 3] uint8.
        source: Name of the file; empty without points.
        gaussians: True if the file contains Gaussians. Colours of Gaussians are not read.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    source: str = ""
    gaussians: bool = False

    @property
    def note(self) -> str:
        """Part of a note to the user: the number of points and their file."""
        if not self.source:
            return "no points"
        return f"{len(self.positions)} points from {self.source}"


NO_POINTS: Final = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


def read_cloud(path: Path, source: str) -> PointCloud:
    """Read the positions and colours of a PLY, LAS or LAZ file.

    Points are grey if the file contains no colours.

    Raises:
        UserError: The file is not a point cloud, or laspy is missing for a LAS or LAZ file.
    """
    is_las = path.suffix.lower() in SUFFIXES
    columns = read_las(path) if is_las else read_vertices(path).columns
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise UserError(
            "the PLY file has no positions",
            where=path,
            expected="vertices with properties x, y and z",
            found=f"no {', '.join(missing)}",
            todo="export the points again",
        )
    # Converting a signalling NaN causes a warning. Points with NaN are left out later, with a note.
    with np.errstate(invalid="ignore"):
        positions = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return PointCloud(
        positions, _colors(columns, len(positions)), source, gaussians=columns.keys() >= _GAUSSIAN
    )


def _colors(columns: Mapping[str, NDArray[np.generic]], count: int) -> NDArray[np.uint8]:
    """Convert colours to uint8 [P, 3].

    Integers up to 255 or 65,535, and fractions up to 1, are accepted.
    """
    names = next((names for names in _COLORS if all(name in columns for name in names)), None)
    if names is None:
        return np.full((count, 3), _GREY, dtype=np.uint8)
    stored = np.stack([columns[name] for name in names], axis=1)
    if stored.dtype == np.uint8:
        return stored
    with np.errstate(invalid="ignore"):
        values = np.nan_to_num(stored.astype(np.float64))
    # A text file does not store the type of its numbers. If any value is above 1, the values are
    # integers. If many values are far above 255, the values are 16-bit integers, which scanners
    # write.
    sizes = np.abs(values[np.isfinite(stored)])
    long = len(sizes) > 0 and np.percentile(sizes, _MOST) >= _LONG
    top = 1.0 if sizes.max(initial=0.0) <= 1.0 else 65_535.0 if long else 255.0
    return np.rint(values.clip(0.0, top) * (255.0 / top)).astype(np.uint8)


def read_las(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read the columns x, y and z of the points.

    If the file contains colours, also read red, green and blue.

    Raises:
        UserError: laspy is missing, or the file cannot be read.
    """
    _require_laspy(path)
    import laspy

    try:
        with open_file(path) as file, laspy.open(file) as reader:
            rows = list(_rows(reader))
            expected, names = reader.header.point_count, _names(reader)
    # For a damaged file, numpy, struct or the decompressor can raise any error.
    except Exception as error:
        raise UserError(
            "the point cloud cannot be read",
            where=path,
            expected="a LAS or LAZ file",
            found=str(error) or type(error).__name__,
            todo="export the points again, or convert them to PLY",
        ) from error
    points_read = sum(count for count, _ in rows)
    if points_read < expected:
        raise UserError(
            "the LAS file is incomplete: its end is missing",
            where=path,
            expected=f"{expected:,} points",
            found=f"{points_read:,} points",
            todo="copy or export the file again",
        )
    tables = [table for _, table in rows]
    table = np.concatenate(tables) if tables else np.zeros((0, len(names)))
    return {name: table[:, i] for i, name in enumerate(names)}


def _rows(reader: "laspy.LasReader") -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield each part of the file: its number of points, and the kept points [n, 3 or 6]."""
    names, start = _names(reader), 0
    stride = -(-reader.header.point_count // _MOST_IN_LAS) or 1
    for chunk in reader.chunk_iterator(_AT_ONCE):
        kept = slice(-start % stride, None, stride)
        columns = [np.asarray(chunk[name], dtype=np.float64)[kept] for name in names]
        yield len(chunk), np.stack(columns, axis=1)
        start += len(chunk)


def _names(reader: "laspy.LasReader") -> tuple[str, ...]:
    dimensions = set(reader.header.point_format.dimension_names)
    return ("x", "y", "z", *(_RGB if dimensions.issuperset(_RGB) else ()))


def _require_laspy(path: Path) -> None:
    packages = ("laspy", "lazrs")[: 1 + (path.suffix.lower() == SUFFIXES[1])]
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise UserError(
            "point clouds in LAS and LAZ format need a package that is not installed",
            where=path,
            expected=f"the package {missing[0]}",
            todo="pip install 'crossgrad[las]', or convert the points to PLY",
        )


def thinned(points: CheckedPoints, most: int) -> tuple[CheckedPoints, list[str]]:
    """Return at most `most` of the points, and a note.

    Of all points in a cube of a grid, one point is kept.

    The kept point is the first point of the cube in the order of the file. Equal files therefore
    give equal points.
    """
    count = len(points.xyz)
    if count <= most:
        return points, []
    rows, side = _one_per_cube(points.xyz, most)
    chosen = np.zeros(count, dtype=np.bool_)
    chosen[rows] = True
    how = f"one in each cube with a side of {side:.3g} input units" if side else "evenly spaced"
    kept = f"{len(rows):,} of {count:,} kept, {how}"
    return points.selected(chosen), [f"points: {kept} (--set data.max_points=N keeps more)"]


def _one_per_cube(xyz: NDArray[np.float64], most: int) -> tuple[NDArray[np.int64], float]:
    """Return the row of the first point in each cube, and the side of the cubes.

    There are at most `most` rows.

    If every tried cube size leaves too many points, evenly spaced rows are returned with a side of
    0.
    """
    sample = xyz[:: -(-len(xyz) // _SAMPLED)]
    low, high = np.percentile(sample, [1.0, 99.0], axis=0)
    span = float((high - low).max())
    side = max(span, _SMALLEST) / most ** (1.0 / _SURFACE)
    best = np.arange(0, len(xyz), -(-len(xyz) // most))
    best_side, few, many = 0.0, np.inf, 0.0
    for _ in range(_TRIES):
        rows = _first_in_cubes((xyz - low) / side)
        if len(rows) <= most:
            few = side
            if best_side == 0.0 or len(rows) > len(best):
                best, best_side = rows, side
            if len(rows) >= _ENOUGH * most:
                break
        else:
            many = side
        guess = side * (len(rows) / (0.9 * most)) ** (1.0 / _SURFACE)
        side = guess if many < guess < few else float(np.sqrt(many * few))
    return best, best_side


def _first_in_cubes(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the row of the first point in each unit cube, in ascending order."""
    cubes = np.floor(places.clip(-_FARTHEST, _FARTHEST)).astype(np.int64).astype(np.uint64)
    keys = (cubes * _FACTORS).sum(axis=1, dtype=np.uint64)
    return np.sort(np.unique(keys, return_index=True)[1])
