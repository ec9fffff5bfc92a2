"""GLB, the binary file of glTF, with the Khronos extension for Gaussians."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import (
    ExportContent,
    Exporter,
    Gaussians,
    Rounding,
    Similarity,
    atomic_file,
)
from crossgrad_plugins.exporters.file_units import FileCloud
from crossgrad_plugins.exporters.glb_file import write_glb
from crossgrad_plugins.exporters.glb_reading import degree_of, read_glb
from crossgrad_plugins.exporters.ply_cloud import SplatCloud


class Glb(Exporter):
    """GLB with KHR_gaussian_splatting: float32, y up; programs without it show coloured points."""

    suffix: ClassVar[str] = "glb"
    up: ClassVar[str] = "y"

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        cloud = SplatCloud.from_gaussians(content.gaussians)
        units = FileCloud.of(cloud, content.similarity, path.name)
        with atomic_file(path) as file:
            write_glb(file, units.cloud, units.offset, content.comments)
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        units = FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity)
        # The node of the file contains the offset.
        return replace(units.float32_rounding, offset=np.zeros(3))

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        return read_glb(path, similarity)

    @override
    def sh_degree_of(self, path: Path) -> int:
        return degree_of(path)
