"""The `.splat` file of antimatter15's viewer: 32 bytes per Gaussian, without spherical harmonics.

Source: the format of github.com/antimatter15/splat (MIT). A row has three float32 for the position,
three float32 for the standard deviations, RGBA as bytes, and the rotation wxyz as bytes.
"""

from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import override

from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.plugin import (
    ExportContent,
    Exporter,
    Gaussians,
    Rounding,
    Similarity,
    UserError,
    atomic_file,
)
from crossgrad_plugins.exporters.file_units import FileCloud, bytes_of, position_offset
from crossgrad_plugins.exporters.ply_cloud import REST, SplatCloud

_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotations", "u1", 4)]
)
_OPACITY_MARGIN = 2.0**-24
#: The byte of a rotation component of 0, and the steps per unit.
_ZERO = 128
_LARGEST_SCALE = float(np.exp(80.0))


class Splat(Exporter):
    """The `.splat` file: 32 bytes per Gaussian, colours of 8 bits, no spherical harmonics."""

    suffix: ClassVar[str] = "splat"
    lossy: ClassVar[bool] = True

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        units = _units(content.gaussians, content.similarity, path.name)
        rows = _rows(units.cloud)
        with atomic_file(path, rows.nbytes) as file:
            file.write(rows.tobytes())
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        return _units(gaussians, similarity).float32_rounding

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        units = _units(gaussians, similarity)
        return _cloud(_rows(units.cloud)).to_local(units.relative(similarity)).to_gaussians()

    @override
    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        # The file has no field for the offset that `write` subtracts far from the origin.
        offset = position_offset(similarity)
        there = Similarity(similarity.offset - offset, similarity.scale)
        return _cloud(_read(path)).to_local(there).to_gaussians()

    @override
    def sh_degree_of(self, path: Path) -> int:
        _read(path)
        return 0


def _units(gaussians: Gaussians, similarity: Similarity, name: str = "") -> FileCloud:
    return FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity, name)


def _rows(cloud: SplatCloud) -> np.ndarray:
    """Return [N] rows of the file."""
    rows = np.zeros(len(cloud), dtype=_ROW)
    opacities = 1 / (1 + np.exp(-cloud.logit_opacities.astype(np.float64)))
    colors = np.concatenate([0.5 + SH_C0 * cloud.sh_dc, opacities[:, None]], axis=1)
    lengths = np.maximum(np.linalg.norm(cloud.quats, axis=1, keepdims=True), 1e-30)
    rows["means"] = cloud.means
    rows["scales"] = np.exp(cloud.log_scales)
    rows["rgba"] = np.round(np.clip(colors, 0.0, 1.0) * 255)
    rows["rotations"] = np.clip(np.round(cloud.quats / lengths * _ZERO + _ZERO), 0, 255)
    return rows


def _cloud(rows: np.ndarray) -> SplatCloud:
    """Return the Gaussians of the rows of a file."""
    opacity = np.clip(rows["rgba"][:, 3] / 255.0, _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
    return SplatCloud(
        means=rows["means"].astype(np.float64),
        log_scales=np.log(np.maximum(rows["scales"], np.finfo(np.float32).tiny)),
        quats=(rows["rotations"].astype(np.float32) - _ZERO) / np.float32(_ZERO),
        logit_opacities=(np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        sh_dc=((rows["rgba"][:, :3] / 255.0 - 0.5) / SH_C0).astype(np.float32),
        sh_rest=np.zeros((len(rows), REST, 3), dtype=np.float32),
    )


def _read(path: Path) -> np.ndarray:
    content = bytes_of(path)
    found = f"{len(content):,} bytes" if len(content) % _ROW.itemsize or not content else ""
    rows = np.frombuffer(content, dtype=_ROW, count=len(content) // _ROW.itemsize)
    if not found and not (
        np.isfinite(rows["means"]).all()
        and (rows["scales"] >= 0).all()
        and (rows["scales"] <= _LARGEST_SCALE).all()
        and (rows["rotations"] != _ZERO).any(axis=1).all()
    ):
        found = "positions, sizes or rotations that are not numbers in range"
    if found:
        raise UserError(
            "the .splat file cannot be read",
            where=path,
            expected="rows of 32 bytes with finite positions and sizes",
            found=found,
            todo="copy, download or export the file again",
        )
    return rows
