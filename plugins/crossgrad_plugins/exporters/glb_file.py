"""GLB files with Gaussians: the container, and the extension KHR_gaussian_splatting.

Source: glTF 2.0 and its extensions KHR_gaussian_splatting and
KHR_gaussian_splatting_compression_spz_2 (Khronos).
"""

import json
import struct
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.plugin import UserError
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import unit_quaternions

EXTENSION: Final = "KHR_gaussian_splatting"
COMPRESSION: Final = "KHR_gaussian_splatting_compression_spz_2"
#: How viewers draw the Gaussians.
DRAWN: Final = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
GLB, JSON, BIN = b"glTF", b"JSON", b"BIN\0"
HEADER, CHUNK_HEADER = struct.Struct("<4sII"), struct.Struct("<I4s")
WIDTHS: Final = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_FLOAT, _BYTE = 5126, 5121
NUMBERS: Final = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_VERTICES: Final = 34962
_ROWS: Final = 65_536
#: Lengths in a file are unsigned numbers of 32 bits.
_LARGEST: Final = 2**32 - 1


def write_container(
    file: BinaryIO, document: Mapping[str, Any], content: Iterable[bytes], size: int
) -> None:
    """Write a GLB file.

    Args:
        file: The open file.
        document: The JSON of glTF.
        content: The parts of the buffer.
        size: Number of bytes of the buffer.
    """
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    filled = size + (-size % 4)
    total = HEADER.size + 2 * CHUNK_HEADER.size + len(text) + filled
    file.write(HEADER.pack(GLB, 2, total) + CHUNK_HEADER.pack(len(text), JSON) + text)
    file.write(CHUNK_HEADER.pack(filled, BIN))
    file.writelines(content)
    file.write(bytes(filled - size))


def document_of(
    primitive: Mapping[str, Any],
    node: Mapping[str, Any],
    accessors: list[dict[str, Any]],
    lengths: Iterable[int],
) -> dict[str, Any]:
    """Return the JSON of glTF with one primitive of points.

    Args:
        primitive: Attributes and extension of the primitive.
        node: The place of the primitive.
        accessors: The accessors.
        lengths: Number of bytes of each buffer view; the views follow each other.
    """
    views, start = [], 0
    for length in lengths:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length})
        start += length
    return {
        "asset": {"version": "2.0", "generator": "crossgrad"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{**primitive, "mode": 0}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }


def attribute_names(degree: int) -> list[str]:
    """Return the names of the attributes of bands 1 to `degree`."""
    return [
        f"{EXTENSION}:SH_DEGREE_{band}_COEF_{number}"
        for band in range(1, degree + 1)
        for number in range(2 * band + 1)
    ]


def write_glb(
    file: BinaryIO, cloud: SplatCloud, offset: NDArray[np.float64], comments: tuple[str, ...]
) -> None:
    """Write a cloud in the units of the file with float32 attributes.

    Args:
        file: The open file.
        cloud: At least one Gaussian, all finite.
        offset: [3] is added to all positions, as the translation of the node.
        comments: Lines of plain text.

    Raises:
        UserError: There are more Gaussians than a file can hold.
    """
    columns = [*_columns(cloud)]
    lengths = [len(cloud) * width * (1 if kind == _BYTE else 4) for _, width, kind, _ in columns]
    accessors: list[dict[str, Any]] = []
    for view, (_, width, kind, _) in enumerate(columns):
        shape = next(name for name, number in WIDTHS.items() if number == width)
        accessor = {
            "bufferView": view,
            "componentType": kind,
            "count": len(cloud),
            "type": shape,
        }
        accessors.append({**accessor, "normalized": True} if kind == _BYTE else accessor)
    means = cloud.means.astype(np.float32)
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    primitive = {
        "attributes": {name: number for number, (name, *_) in enumerate(columns)},
        "extensions": {EXTENSION: DRAWN},
    }
    node = {"translation": offset.tolist()} if offset.any() else {}
    document = document_of(primitive, node, accessors, lengths)
    for view in document["bufferViews"]:
        view["target"] = _VERTICES
    if comments:
        document["asset"]["extras"] = {"comments": list(comments)}
    if sum(lengths) > _LARGEST - 2**20:
        raise UserError(
            "a GLB file cannot contain this number of Gaussians",
            expected="at most 4 GiB, 18 million Gaussians with all spherical harmonics",
            found=f"{len(cloud):,}",
            todo="give --max-gaussians or --sh-degree, or choose the format spz or tiles",
        )
    write_container(file, document, _rows(columns, len(cloud)), sum(lengths))


def _columns(cloud: SplatCloud) -> Iterator[tuple[str, int, int, Any]]:
    """Yield name, width, kind of number, and function rows -> values of each attribute."""

    def opacities(rows: slice) -> NDArray[Any]:
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-cloud.logit_opacities[rows, None])))

    def colors(rows: slice) -> NDArray[Any]:
        drawn = np.concatenate([cloud.sh_dc[rows] * SH_C0 + 0.5, opacities(rows)], axis=1)
        return np.asarray(np.rint(np.clip(drawn, 0, 1) * 255))

    def rotations(rows: slice) -> NDArray[Any]:
        return unit_quaternions(cloud.quats[rows])

    yield "POSITION", 3, _FLOAT, lambda rows: cloud.means[rows]
    # Programs without the extension show points of this colour.
    yield "COLOR_0", 4, _BYTE, colors
    yield f"{EXTENSION}:ROTATION", 4, _FLOAT, rotations
    yield f"{EXTENSION}:SCALE", 3, _FLOAT, lambda rows: np.exp(cloud.log_scales[rows])
    yield f"{EXTENSION}:OPACITY", 1, _FLOAT, opacities
    yield f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3, _FLOAT, lambda rows: cloud.sh_dc[rows]
    for number, name in enumerate(attribute_names(cloud.sh_degree)):
        yield name, 3, _FLOAT, lambda rows, number=number: cloud.sh_rest[rows, number]


def _rows(columns: list[tuple[str, int, int, Any]], count: int) -> Iterator[bytes]:
    for _, _, kind, values in columns:
        for start in range(0, count, _ROWS):
            yield values(slice(start, start + _ROWS)).astype(NUMBERS[kind]).tobytes()
