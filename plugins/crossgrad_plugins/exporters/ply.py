"""The PLY file of 3DGS, which all viewers of Gaussians can open."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Exporter, Gaussians, Rounding, Similarity
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import (
    position_rounding,
    read_ply,
    sh_degree_of,
    write_ply,
)


class Ply(Exporter):
    """The standard PLY of 3DGS: spherical harmonics, log scales, logits of opacities."""

    suffix: ClassVar[str] = "ply"

    @override
    def write(
        self, gaussians: Gaussians, similarity: Similarity, path: Path, comments: Sequence[str]
    ) -> tuple[str, ...]:
        return write_ply(path, SplatCloud.from_gaussians(gaussians), similarity, comments)

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        return position_rounding(SplatCloud.from_gaussians(gaussians), similarity)

    @override
    def stored(self, gaussians: Gaussians) -> Gaussians:
        return SplatCloud.from_gaussians(gaussians).to_gaussians()

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        return read_ply(path).to_local(similarity).to_gaussians()

    @override
    def sh_degree_of(self, path: Path) -> int:
        return sh_degree_of(path)
