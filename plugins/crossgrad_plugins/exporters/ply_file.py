"""Standard 3DGS PLY files (property order of Inria), as common viewers read them.

Source: 3DGS. The properties are `x y z nx ny nz f_dc f_rest opacity scale rot`, float32
little-endian. `f_rest` is channel-major: 15 red coefficients, 15 green, 15 blue.
"""

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import COEFFICIENTS
from crossgrad_core.plugin import (
    COORDINATES_TAG,
    Similarity,
    UserError,
    atomic_file,
    read_vertices,
    vertex_properties,
)
from crossgrad_plugins.exporters.file_units import FileCloud, plain_number
from crossgrad_plugins.exporters.ply_cloud import REST, RenderMode, SplatCloud

#: Names of the properties in the order of the file.
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
_NEEDED = tuple(name for name in PROPERTIES if not name.startswith(("n", "f_rest_")))
_OFFSET_TAG = "crossgrad_offset:"
_MODE_TAG = "SplatRenderMode:"
_CHUNK = 65_536
_LARGEST = float(np.finfo(np.float32).max)
#: Natural logarithm of the largest size. Float32 numbers end at about e^88.
_LARGEST_LOG_SCALE = 80.0
#: Allowed length of a rotation quaternion, so that float32 can represent its square.
_ROTATION_LENGTHS = (1e-18, 1e18)
_OFFSET = re.compile(r"\s+".join([r"([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"] * 3))
_IDENTITY = Similarity(np.zeros(3), 1.0)


def write_ply(
    path: Path,
    cloud: SplatCloud,
    similarity: Similarity = _IDENTITY,
    comments: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write a cloud of the local frame in input coordinates; only a complete file appears.

    Positions are relative to the offset of `FileCloud`. The offset is written to a comment
    `crossgrad_offset: x y z`, and `read_ply` adds it again.

    Args:
        path: The file.
        cloud: Gaussians in the local frame.
        similarity: Maps the local frame back to the input frame.
        comments: Further lines for the header, plain text.

    Returns:
        Notes about the file for the user, one sentence each; usually empty.

    Raises:
        UserError: The disk is full or the folder is not writable.
    """
    units = FileCloud.of(cloud, similarity, path.name)
    moved = units.cloud
    tags = [f"{_MODE_TAG} {cloud.render_mode}"]
    if units.offset.any():
        tags.append(f"{_OFFSET_TAG} {' '.join(plain_number(value) for value in units.offset)}")
    header = _header(len(moved), [*tags, *comments])
    with atomic_file(path, len(header) + 4 * len(PROPERTIES) * len(moved)) as file:
        file.write(header)
        for start in range(0, len(moved), _CHUNK):
            file.write(_rows(moved, slice(start, start + _CHUNK)).tobytes())
    return units.notes


def read_ply(path: Path) -> SplatCloud:
    """Read Gaussians by property name: any order and types, with or without normals, degree 0-3.

    Returns:
        The cloud in the frame of the file, with `crossgrad_offset` added.

    Raises:
        UserError: The file is not a PLY file, has no Gaussians, is truncated, contains non-finite
            numbers, or has other coordinates than the scene's input.
    """
    vertices = read_vertices(path)
    _check_coordinates(vertices.comments, path)
    _require_properties(vertices.columns, path)
    rest = _rest_names(vertices.columns, path)
    _require_gaussians(len(vertices.columns["x"]), path)
    for name in (*_NEEDED, *rest):
        top = _LARGEST_LOG_SCALE if name.startswith("scale_") else _LARGEST
        _check_finite(vertices.columns[name], name, path, top)

    def stacked(names: Sequence[str]) -> NDArray[np.float32]:
        return np.stack([vertices.columns[name] for name in names], axis=1, dtype=np.float32)

    quats = stacked([f"rot_{i}" for i in range(4)])
    _check_rotations(quats, path)
    means = np.stack([vertices.columns[axis] for axis in "xyz"], axis=1, dtype=np.float64)
    sh_rest = np.zeros((len(means), REST, 3), dtype=np.float32)
    if rest:
        bands = stacked(rest).reshape(len(means), 3, len(rest) // 3)  # channel-major
        sh_rest[:, : bands.shape[2]] = bands.transpose(0, 2, 1)
    return SplatCloud(
        means=means + _offset(vertices.comments, path),
        log_scales=stacked([f"scale_{i}" for i in range(3)]),
        quats=quats,
        logit_opacities=stacked(["opacity"])[:, 0],
        sh_dc=stacked([f"f_dc_{i}" for i in range(3)]),
        sh_rest=sh_rest,
        render_mode=_render_mode(vertices.comments, path),
    )


def sh_degree_of(path: Path) -> int:
    """Return the SH degree of a PLY file of Gaussians from its header alone.

    Raises:
        UserError: The file is not a PLY file, has no Gaussians, or has an unusual number of
            coefficients.
    """
    properties = vertex_properties(path)
    _require_properties(properties, path)
    return COEFFICIENTS.index(1 + len(_rest_names(properties, path)) // 3)


def _header(count: int, comments: Sequence[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(text.split())}" for text in comments]
    lines += [f"element vertex {count}", *(f"property float {name}" for name in PROPERTIES)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", errors="replace")


def _rows(cloud: SplatCloud, rows: slice) -> NDArray[np.float32]:
    """Return [n, 62] little-endian rows of the table."""
    means = cloud.means[rows]
    count = len(means)
    columns = (
        means,
        np.zeros((count, 3)),
        cloud.sh_dc[rows],
        cloud.sh_rest[rows].transpose(0, 2, 1).reshape(count, 3 * REST),
        cloud.logit_opacities[rows, None],
        cloud.log_scales[rows],
        cloud.quats[rows],
    )
    return np.concatenate([column.astype("<f4") for column in columns], axis=1)


def _rest_names(columns: Collection[str], path: Path) -> list[str]:
    count = sum(name.startswith("f_rest_") for name in columns)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45) or any(name not in columns for name in names):
        raise UserError(
            "the PLY file has an unusual number of spherical-harmonics coefficients",
            where=path,
            expected="0, 9, 24 or 45 properties f_rest_0, f_rest_1 ...",
            found=f"{count}",
            todo="export the file again with complete bands of spherical harmonics",
        )
    return names


def _require_gaussians(count: int, path: Path) -> None:
    if count == 0:
        raise UserError(
            "the PLY file contains no Gaussians",
            where=path,
            expected="at least one vertex",
            found="0 vertices",
            todo="export the Gaussians again, or start from the SfM points (--init points)",
        )


def _check_rotations(quats: NDArray[np.float32], path: Path) -> None:
    lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
    shortest, longest = _ROTATION_LENGTHS
    wrong = (lengths < shortest) | (lengths > longest)
    if wrong.any():
        raise UserError(
            "the PLY file contains a rotation quaternion whose length is too small or too large",
            where=path,
            expected=f"quaternions rot_0 ... rot_3 of length {shortest:g} to {longest:g}",
            found=f"{int(wrong.sum()):,} of {len(quats):,} outside this range",
            todo="remove these Gaussians, or export the file again",
        )


def _require_properties(names: Collection[str], path: Path) -> None:
    missing = [name for name in _NEEDED if name not in names]
    if not missing:
        return
    packed, points = "packed_position" in names, {"x", "y", "z"} <= set(names)
    todo = (
        "decompress it, e.g. with splat-transform"
        if packed
        else (f"use --points {path} to start from its points; --init needs a file of Gaussians")
        if points
        else "export the Gaussians, not the sparse points or a mesh"
    )
    raise UserError(
        "the PLY file is compressed" if packed else "the PLY file contains no Gaussians",
        where=path,
        expected="the properties of a standard 3DGS PLY file",
        found=f"no {', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}",  # noqa: PLR2004
        todo=todo,
    )


def _check_finite(column: NDArray[np.generic], name: str, path: Path, top: float) -> None:
    # Values beyond the range of float32 count as infinite. NaN also fails the comparison.
    with np.errstate(invalid="ignore"):  # A signalling NaN causes this warning
        numbers = column.astype(np.float64)
    valid = (numbers >= -_LARGEST) & (numbers <= top)
    if not valid.all():
        raise UserError(
            "the PLY file contains numbers that are not finite",
            where=path,
            found=f"{np.sum(~valid):,} of {len(column):,} values of {name}",
            todo="remove these Gaussians, or export the file again",
        )


def _tagged(comments: Sequence[str], tag: str) -> str | None:
    for comment in comments:
        if comment.startswith(tag):
            return comment.removeprefix(tag).strip()
    return None


def _offset(comments: Sequence[str], path: Path) -> NDArray[np.float64]:
    text = _tagged(comments, _OFFSET_TAG)
    if text is None:
        return np.zeros(3)
    match = _OFFSET.fullmatch(text)
    offset = np.array([float(word) for word in match.groups()] if match else [np.nan] * 3)
    if not (np.abs(offset) <= _LARGEST).all():
        raise UserError(
            "the coordinate offset in the PLY file cannot be read",
            where=path,
            expected="three numbers",
            found=text,
            todo=f"repair or remove the comment that starts with {_OFFSET_TAG}",
        )
    return offset


def _check_coordinates(comments: Sequence[str], path: Path) -> None:
    coordinates = _tagged(comments, COORDINATES_TAG)
    if coordinates is not None:
        raise UserError(
            "the PLY file uses other coordinates than the scene",
            where=path,
            expected="the coordinates of the scene's input files",
            found=coordinates,
            todo="export the file again with --coordinates input",
        )


def _render_mode(comments: Sequence[str], path: Path) -> RenderMode:
    text = _tagged(comments, _MODE_TAG)
    if text is None or text == "default":
        return "default"
    if text == "mip":
        return "mip"
    raise UserError(
        "the PLY file was made for another renderer",
        where=path,
        expected=f"{_MODE_TAG} default or mip",
        found=text,
        todo=f"remove the comment if the Gaussians should be rendered as with {_MODE_TAG} default",
    )
