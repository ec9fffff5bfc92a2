"""Point clouds in LAS and LAZ files, through the package laspy where it is installed.

Source of the format: ASPRS, LAS specification 1.4. Positions are whole numbers times the scale plus
the offset of the header, which laspy applies in float64.
"""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.system.input_files import open_file

if TYPE_CHECKING:
    import laspy

#: What the names of such files end in.
SUFFIXES: Final = (".las", ".laz")
_RGB: Final = ("red", "green", "blue")
_AT_ONCE: Final = 1_000_000
#: Points that are read of a file, at most: of more, each second, third ... one.
_MOST: Final = 20_000_000


def read_las(path: Path) -> dict[str, NDArray[np.generic]]:
    """The columns x, y and z of the points, and red, green and blue where the file has colours.

    Raises:
        UserError: laspy is missing, or the file cannot be read.
    """
    _require_laspy(path)
    import laspy

    try:
        with open_file(path) as file, laspy.open(file) as reader:
            rows = list(_rows(reader))
            expected, names = reader.header.point_count, _names(reader)
    # Damaged files end in whatever numpy, struct or the decompressor raise.
    except Exception as error:
        raise UserError(
            "the point cloud cannot be read",
            where=path,
            expected="a LAS or LAZ file",
            found=str(error) or type(error).__name__,
            todo="export the points again, or convert them to PLY",
        ) from error
    found = sum(count for count, _ in rows)
    if found < expected:
        raise UserError(
            "LAS file ends too early",
            where=path,
            expected=f"{expected:,} points",
            found=f"{found:,} points",
            todo="copy or export the file again",
        )
    tables = [table for _, table in rows]
    table = np.concatenate(tables) if tables else np.zeros((0, len(names)))
    return {name: table[:, i] for i, name in enumerate(names)}


def _rows(reader: "laspy.LasReader") -> Iterator[tuple[int, NDArray[np.float64]]]:
    """How many points a part of the file has, and the rows [n, 3 or 6] that are kept of them."""
    names, start = _names(reader), 0
    stride = -(-reader.header.point_count // _MOST) or 1
    for part in reader.chunk_iterator(_AT_ONCE):
        kept = slice(-start % stride, None, stride)
        columns = [np.asarray(part[name], dtype=np.float64)[kept] for name in names]
        yield len(part), np.stack(columns, axis=1)
        start += len(part)


def _names(reader: "laspy.LasReader") -> tuple[str, ...]:
    known = set(reader.header.point_format.dimension_names)
    return ("x", "y", "z", *(_RGB if known.issuperset(_RGB) else ()))


def _require_laspy(path: Path) -> None:
    packages = ("laspy", "lazrs")[: 1 + (path.suffix.lower() == SUFFIXES[1])]
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise UserError(
            "point clouds in LAS and LAZ need a package that is not installed",
            where=path,
            expected=f"the package {missing[0]}",
            todo="pip install 'crossgrad[las]', or convert the points to PLY",
        )
