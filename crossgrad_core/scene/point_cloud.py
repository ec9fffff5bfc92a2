"""Point clouds: positions and colours from a PLY, LAS or LAZ file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.las import SUFFIXES, read_las
from crossgrad_core.system.ply_table import read_vertices

#: What the names of point clouds end in.
CLOUDS: Final = (".ply", *SUFFIXES)
_GREY: Final = 127
#: Colours have 16 bits if this percentile of them is at least `_LONG`.
_MOST: Final = 99.0
_LONG: Final = 512.0
_COLORS: Final = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
#: Properties that Gaussians have and points lack.
_GAUSSIAN: Final = frozenset({"f_dc_0", "opacity", "scale_0", "rot_0"})


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of the input.

    Attributes:
        positions: [P, 3] float64.
        colors: [P, 3] uint8.
        source: File that they come from; empty where there are none.
        gaussians: Whether the file holds Gaussians, whose colours are not read.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    source: str = ""
    gaussians: bool = False

    @property
    def note(self) -> str:
        """Part of a note: how many there are, and from where."""
        if not self.source:
            return "no points"
        return f"{len(self.positions)} points from {self.source}"


NO_POINTS: Final = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


def read_cloud(path: Path, source: str) -> PointCloud:
    """Positions and colours of a PLY, LAS or LAZ file; grey if it has no colours.

    Raises:
        UserError: It is no such file, or laspy is missing for LAS and LAZ.
    """
    is_las = path.suffix.lower() in SUFFIXES
    columns = read_las(path) if is_las else read_vertices(path).columns
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise UserError(
            "PLY file without positions",
            where=path,
            expected="vertices with properties x, y and z",
            found=f"no {', '.join(missing)}",
            todo="export the points again",
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN; those are left out with a note
        positions = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return PointCloud(
        positions, _colors(columns, len(positions)), source, gaussians=columns.keys() >= _GAUSSIAN
    )


def _colors(columns: Mapping[str, NDArray[np.generic]], count: int) -> NDArray[np.uint8]:
    """[P, 3] from whole numbers to 255 or to 65,535, or from fractions to 1."""
    names = next((names for names in _COLORS if all(name in columns for name in names)), None)
    if names is None:
        return np.full((count, 3), _GREY, dtype=np.uint8)
    stored = np.stack([columns[name] for name in names], axis=1)
    if stored.dtype == np.uint8:
        return stored
    with np.errstate(invalid="ignore"):
        values = np.nan_to_num(stored.astype(np.float64))
    # Text files hold no types: numbers above 1 are of the whole kind, and far above 255 of the
    # longer one, as scanners write.
    sizes = np.abs(values[np.isfinite(stored)])
    long = len(sizes) > 0 and np.percentile(sizes, _MOST) >= _LONG
    top = 1.0 if sizes.max(initial=0.0) <= 1.0 else 65_535.0 if long else 255.0
    return np.rint(values.clip(0.0, top) * (255.0 / top)).astype(np.uint8)
