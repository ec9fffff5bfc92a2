"""SOG, the small file that PlayCanvas and SuperSplat recommend for delivery."""

from pathlib import Path
from typing import ClassVar

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
from crossgrad_plugins.exporters.sog_file import bands_of, packed, unpacked


class Sog(Exporter):
    """SOG of PlayCanvas: about 30 bytes per Gaussian in lossless images; loses about 0.1 dB."""

    suffix: ClassVar[str] = "sog"
    lossy: ClassVar[bool] = True
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased"})

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        units = _units(content.gaussians, content.similarity, path.name)
        packing = packed(units.cloud, units.offset, content.comments)
        with atomic_file(path, len(packing)) as file:
            file.write(packing)
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        return Rounding(_units(gaussians, similarity).offset)

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        units = _units(gaussians, similarity)
        cloud = unpacked(packed(units.cloud, units.offset), Path("a.sog"))
        return cloud.to_local(similarity).to_gaussians()

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        return unpacked(bytes_of(path), path).to_local(similarity).to_gaussians()

    @override
    def sh_degree_of(self, path: Path) -> int:
        return bands_of(path)


def _units(gaussians: Gaussians, similarity: Similarity, name: str = "") -> FileCloud:
    return FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity, name)
