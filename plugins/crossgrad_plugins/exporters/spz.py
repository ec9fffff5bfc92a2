"""SPZ, a small file that web viewers and Cesium read."""

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    ExportContent,
    Exporter,
    Gaussians,
    Response,
    Rounding,
    Similarity,
    atomic_file,
)
from crossgrad_plugins.exporters.file_units import FileCloud, bytes_of
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import SpzTable, spz_degree


class Spz(Exporter):
    """SPZ of Niantic: about 20 bytes per Gaussian, with a small loss; y up."""

    suffix: ClassVar[str] = "spz"
    lossy: ClassVar[bool] = True
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased"})

    version: Literal[2, 3] = Field(
        2, description="Version of the format; 3 has finer rotations, and Cesium needs 2."
    )

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        units = _units(content.gaussians, content.similarity, path.name)
        with atomic_file(path) as file:
            for part in SpzTable.of(units.cloud, self.version).packed():
                file.write(part)
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        units = _units(gaussians, similarity)
        off = np.abs(SpzTable.of(units.cloud, self.version).means - units.cloud.means)
        return Rounding(units.offset, float(off.max(initial=0.0)))

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        units = _units(gaussians, similarity)
        cloud = SpzTable.of(units.cloud, self.version).to_cloud()
        return cloud.to_local(units.relative(similarity)).to_gaussians()

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        table = SpzTable.unpacked(bytes_of(path), path)
        return table.to_cloud().to_local(similarity).to_gaussians()

    @override
    def sh_degree_of(self, path: Path) -> int:
        return spz_degree(path)


def _units(gaussians: Gaussians, similarity: Similarity, name: str = "") -> FileCloud:
    return FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity, name)
