"""The PLY file of 3DGS, which all viewers of Gaussians can open."""

from pathlib import Path
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import ExportContent, Exporter, Gaussians, Response, Rounding, Similarity
from crossgrad_plugins.exporters.file_units import FileCloud
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import read_ply, sh_degree_of, write_ply


class Ply(Exporter):
    """The standard PLY of 3DGS: spherical harmonics, log scales, logits of opacities."""

    suffix: ClassVar[str] = "ply"
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased"})

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        cloud = SplatCloud.from_gaussians(content.gaussians)
        return write_ply(path, cloud, content.similarity, content.comments)

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        return FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity).float32_rounding

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        return SplatCloud.from_gaussians(gaussians).to_gaussians()

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        return read_ply(path).to_local(similarity).to_gaussians()

    @override
    def sh_degree_of(self, path: Path) -> int:
        return sh_degree_of(path)
