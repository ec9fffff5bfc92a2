"""3D Tiles 1.1: a folder that Cesium streams, in its place on the globe."""

import json
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import (
    ExportContent,
    Exporter,
    Gaussians,
    Rounding,
    Similarity,
    atomic_folder,
)
from crossgrad_plugins.exporters.file_units import FileCloud
from crossgrad_plugins.exporters.glb_file import (
    COMPRESSION,
    DRAWN,
    EXTENSION,
    attribute_names,
    document_of,
    write_container,
)
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import SpzTable
from crossgrad_plugins.exporters.tile_tree import Part, Tile, written_tiles

#: Name of the file that a program opens.
TILESET: Final = "tileset.json"
#: Rotates coordinates of the tile set, z up, to those of its GLB files, y up.
_TO_GLB: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SPZ_VERSION: Final = 2
_FLOAT, _BYTE = 5126, 5121


class Tiles(Exporter):
    """A folder of 3D Tiles with levels of detail, for Cesium; place on Earth if it is known."""

    suffix: ClassVar[str] = ""
    up: ClassVar[str] = "z"
    coordinates: ClassVar[str] = "enu"
    lossy: ClassVar[bool] = True

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        units, part = _divided(content.gaussians, content.similarity, path.name)
        with atomic_folder(path) as folder:
            tile, _ = written_tiles(
                units.cloud, part, lambda name, cloud: _write_tile(folder / f"{name}.glb", cloud)
            )
            tileset = _tileset(tile, _place(content.to_ecef, _TO_GLB.T @ units.offset))
            if content.comments:
                tileset["asset"]["extras"] = {"comments": list(content.comments)}
            text = json.dumps(tileset, indent=1, allow_nan=False)
            (folder / TILESET).write_text(f"{text}\n", encoding="utf-8")
        if content.to_ecef is None:
            place = "the place of the scene on Earth is not known, so the viewer must set it"
            return (*units.notes, f"{path.name}: {place}")
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        units, part = _divided(gaussians, similarity)
        stored = _stored(units.cloud, part)
        off = np.abs(stored.means - units.cloud.means)
        # The transform of the root contains the offset.
        return Rounding(np.zeros(3), float(off.max(initial=0.0)))

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        units, part = _divided(gaussians, similarity)
        relative = units.relative(_turned(similarity))
        local = _stored(units.cloud, part).to_local(relative).to_gaussians()
        return local.rotated(torch.from_numpy(_TO_GLB.T.copy()))


def _divided(
    gaussians: Gaussians, similarity: Similarity, name: str = ""
) -> tuple[FileCloud, Part]:
    """Return the Gaussians in the axes of GLB, and their parts."""
    cloud = SplatCloud.from_gaussians(gaussians.rotated(torch.from_numpy(_TO_GLB)))
    units = FileCloud.of(cloud, _turned(similarity), name)
    return units, Part.of(units.cloud.means, np.arange(len(units.cloud)))


def _turned(similarity: Similarity) -> Similarity:
    return Similarity(_TO_GLB @ similarity.offset, similarity.scale)


def _stored(cloud: SplatCloud, part: Part) -> SplatCloud:
    """Return the Gaussians of the leaves, in the order of `cloud`."""
    leaves = [*part.leaves()]
    clouds = [SpzTable.of(cloud.selected(leaf.rows), _SPZ_VERSION).to_cloud() for leaf in leaves]
    order = np.argsort(np.concatenate([leaf.rows for leaf in leaves]))
    return SplatCloud.joined(clouds).selected(order)


def _place(to_ecef: NDArray[np.float64] | None, offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transform [4, 4] of the root of the tiles."""
    moved = np.eye(4)
    moved[:3, 3] = offset
    return moved if to_ecef is None else to_ecef @ moved


def _tileset(tile: Tile, place: NDArray[np.float64]) -> dict[str, Any]:
    needed = [EXTENSION, COMPRESSION]
    root = _node(tile)
    return {
        "asset": {"version": "1.1", "generator": "crossgrad"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        # Cesium draws Gaussians only if both extensions are required here.
        "extensions": {
            "3DTILES_content_gltf": {"extensionsUsed": needed, "extensionsRequired": needed}
        },
        "geometricError": _diagonal(tile),
        "root": {"transform": place.T.reshape(-1).tolist(), **root},
    }


def _node(tile: Tile) -> dict[str, Any]:
    low, high = tile.box @ _TO_GLB
    low, high = np.minimum(low, high), np.maximum(low, high)
    half = np.diag((high - low) / 2)
    node = {
        "boundingVolume": {"box": [*((low + high) / 2).tolist(), *half.reshape(-1).tolist()]},
        "geometricError": _diagonal(tile) if tile.children else 0.0,
        "refine": "REPLACE",
        "content": {"uri": f"{tile.name}.glb"},
    }
    return {**node, "children": [*map(_node, tile.children)]} if tile.children else node


def _diagonal(tile: Tile) -> float:
    return float(np.linalg.norm(tile.box[1] - tile.box[0]))


def _write_tile(path: Path, cloud: SplatCloud) -> None:
    """Write a GLB file with SPZ inside; its attributes have no data of their own."""
    packed = b"".join(SpzTable.of(cloud, _SPZ_VERSION).packed())
    attributes = {"POSITION": "VEC3", "COLOR_0": "VEC4"}
    attributes |= {f"{EXTENSION}:SCALE": "VEC3", f"{EXTENSION}:ROTATION": "VEC4"}
    attributes |= dict.fromkeys(attribute_names(cloud.sh_degree), "VEC3")
    accessors: list[dict[str, Any]] = [
        {"componentType": _FLOAT, "count": len(cloud), "type": shape}
        for shape in attributes.values()
    ]
    low, high = cloud.means.min(axis=0), cloud.means.max(axis=0)
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    accessors[1] |= {"componentType": _BYTE, "normalized": True}
    compressed = {**DRAWN, "extensions": {COMPRESSION: {"bufferView": 0}}}
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "extensions": {EXTENSION: compressed},
    }
    # Cesium needs the matrix of the node.
    node = {"matrix": np.eye(4).reshape(-1).tolist()}
    document = document_of(primitive, node, accessors, [len(packed)])
    document |= {"extensionsUsed": [EXTENSION, COMPRESSION]}
    document |= {"extensionsRequired": [EXTENSION, COMPRESSION]}
    with path.open("wb") as file:
        write_container(file, document, [packed], len(packed))
