"""Reading of Gaussians from GLB files, by anybody's writer."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import COEFFICIENTS
from crossgrad_core.plugin import Gaussians, Similarity, UserError
from crossgrad_plugins.exporters.file_units import bytes_of, representable
from crossgrad_plugins.exporters.glb_file import (
    BIN,
    CHUNK_HEADER,
    COMPRESSION,
    EXTENSION,
    GLB,
    HEADER,
    JSON,
    NUMBERS,
    WIDTHS,
    attribute_names,
)
from crossgrad_plugins.exporters.ply_cloud import REST, SplatCloud
from crossgrad_plugins.exporters.spz_file import SpzTable

#: Largest share by which the axes of a node may differ from a rotation with one scale.
_UNEVEN: Final = 1e-4
#: Deepest nesting of nodes.
_DEEPEST: Final = 100
_SMALLEST: Final = float(np.finfo(np.float32).tiny)
_OPACITY_MARGIN: Final = 2.0**-24


@dataclass(frozen=True)
class _Glb:
    """The JSON of a file, its buffer and its path."""

    document: dict[str, Any]
    content: bytes
    path: Path

    def view(self, number: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.document["bufferViews"][number]
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if view.get("buffer", 0) != 0 or start < 0 or not 0 <= start + length <= len(self.content):
            raise ValueError("a buffer view outside the file")
        return self.content[start : start + length]

    def values(self, number: int) -> NDArray[np.float64]:
        """Return [N, width] the values of an accessor; normalised integers become fractions."""
        accessor = self.document["accessors"][number]
        view, width = int(accessor["bufferView"]), WIDTHS[accessor["type"]]
        kind = np.dtype(NUMBERS[accessor["componentType"]])
        content, count = self.view(view), int(accessor["count"])
        stride = int(self.document["bufferViews"][view].get("byteStride", width * kind.itemsize))
        table = np.ndarray(
            (count, width),
            kind,
            content,
            int(accessor.get("byteOffset", 0)),
            (stride, kind.itemsize),
        )
        if not accessor.get("normalized", False):
            return table.astype(np.float64)
        return np.maximum(table / float(np.iinfo(kind).max), -1.0)


def read_glb(path: Path, similarity: Similarity) -> Gaussians:
    """Return all Gaussians of a file in the local frame.

    Args:
        path: The file, with float32 or normalised attributes, or with SPZ inside.
        similarity: Maps the local frame to the frame of the file.

    Raises:
        UserError: The file cannot be read, or contains no Gaussians.
    """
    glb = _opened(path)
    try:
        parts = [
            _placed(_cloud(glb, primitive), matrix, similarity)
            for primitive, matrix in _primitives(glb)
        ]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise _damaged(path, str(error) or type(error).__name__) from error
    if not sum(len(part) for part in parts):
        raise _without(path)
    return _joined(parts)


def degree_of(path: Path) -> int:
    """Return the highest degree of spherical harmonics of a file.

    Raises:
        UserError: The file cannot be read, or contains no Gaussians.
    """
    glb = _opened(path)
    try:
        degrees = [_degree(primitive["attributes"]) for primitive, _ in _primitives(glb)]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise _damaged(path, str(error) or type(error).__name__) from error
    if not degrees:
        raise _without(path)
    return max(degrees)


def _opened(path: Path) -> _Glb:
    raw = bytes_of(path)
    start = HEADER.size
    chunks: dict[bytes, bytes] = {}
    if raw[:4] != GLB:
        raise _damaged(path, "another header")
    while start + CHUNK_HEADER.size <= len(raw):
        length, name = CHUNK_HEADER.unpack_from(raw, start)
        start += CHUNK_HEADER.size
        if start + length > len(raw):
            raise _damaged(path, f"{len(raw):,} of at least {start + length:,} bytes")
        chunks.setdefault(name, raw[start : start + length])
        start += length
    try:
        document = json.loads(chunks[JSON])
    except (KeyError, ValueError, RecursionError) as error:
        raise _damaged(path, "no JSON that can be read") from error
    if not isinstance(document, dict):
        raise _damaged(path, "no JSON of glTF")
    return _Glb(document, chunks.get(BIN, b""), path)


def _primitives(glb: _Glb) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Yield each primitive with Gaussians, and the matrix [4, 4] of its node."""
    document = glb.document
    nodes = document.get("nodes", [])
    scenes = document.get("scenes", [{"nodes": range(len(nodes))}])
    open_nodes = [(number, np.eye(4), 0) for number in scenes[document.get("scene", 0)]["nodes"]]
    while open_nodes:
        number, outer, depth = open_nodes.pop(0)
        node = nodes[number]
        matrix = outer @ _matrix(node)
        if depth > _DEEPEST:
            raise ValueError("nodes that contain each other")
        open_nodes += [(child, matrix, depth + 1) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, matrix


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return the transform [4, 4] of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] = np.array(turn) * np.array(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _degree(attributes: dict[str, int]) -> int:
    return max(d for d in range(len(COEFFICIENTS)) if {*attribute_names(d)} <= {*attributes})


def _cloud(glb: _Glb, primitive: dict[str, Any]) -> SplatCloud:
    """Return the Gaussians of a primitive in its own frame."""
    inner = primitive["extensions"][EXTENSION].get("extensions", {})
    if COMPRESSION in inner:
        return SpzTable.unpacked(glb.view(inner[COMPRESSION]["bufferView"]), glb.path).to_cloud()
    attributes = primitive["attributes"]

    def values(name: str) -> NDArray[np.float64]:
        return glb.values(attributes[f"{EXTENSION}:{name}"])

    means = glb.values(attributes["POSITION"])
    rest = np.zeros((len(means), REST, 3), dtype=np.float32)
    for number, name in enumerate(attribute_names(_degree(attributes))):
        rest[:, number] = glb.values(attributes[name])
    opacities = np.clip(values("OPACITY")[:, 0], _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
    cloud = SplatCloud(
        means=means,
        log_scales=np.log(np.maximum(values("SCALE"), _SMALLEST)).astype(np.float32),
        quats=values("ROTATION")[:, [3, 0, 1, 2]].astype(np.float32),
        logit_opacities=np.log(opacities / (1.0 - opacities)).astype(np.float32),
        sh_dc=values("SH_DEGREE_0_COEF_0").astype(np.float32),
        sh_rest=rest,
    )
    valid = representable(cloud) & cloud.quats.any(axis=1)
    if not valid.all():
        raise ValueError(f"{np.sum(~valid):,} Gaussians with values that are not finite")
    return cloud


def _placed(cloud: SplatCloud, matrix: NDArray[np.float64], similarity: Similarity) -> Gaussians:
    """Return the Gaussians of a node in the local frame."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not np.isfinite(matrix).all() or scale <= 0:
        raise ValueError("a node that mirrors or has no extent")
    turn = matrix[:3, :3] / scale
    if np.abs(turn @ turn.T - np.eye(3)).max() > _UNEVEN:
        raise ValueError("a node with unequal scales")
    # The translation is removed before positions are rounded to float32
    offset = (similarity.offset - matrix[:3, 3]) @ turn / scale
    local = cloud.to_local(Similarity(offset, similarity.scale * scale)).to_gaussians()
    return local if np.array_equal(turn, np.eye(3)) else local.rotated(torch.from_numpy(turn))


def _joined(parts: list[Gaussians]) -> Gaussians:
    """Return the Gaussians of all parts; a part of a lower degree has bands of zeros."""
    degree = max(part.sh_degree for part in parts)
    bands = COEFFICIENTS[degree] - 1
    rest = []
    for part in parts:
        padded = torch.zeros((len(part), bands, 3))
        if part.sh_rest is not None:
            padded[:, : part.sh_rest.shape[1]] = part.sh_rest
        rest.append(padded)
    joined: dict[str, Any] = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("means", "quats", "scales", "opacities", "sh_dc")
    }
    return Gaussians(
        **joined,
        sh_rest=torch.cat(rest) if degree else None,
        sh_degree=degree,
        response=parts[0].response,
    )


def _without(path: Path) -> UserError:
    return UserError(
        "the GLB file contains no Gaussians",
        where=path,
        expected=f"points with the extension {EXTENSION}",
        todo="export the Gaussians again",
    )


def _damaged(path: Path, found: str) -> UserError:
    return UserError(
        "the file is not a complete GLB file of Gaussians",
        where=path,
        found=found,
        todo="copy it again, or export the Gaussians again",
    )
