"""Compressed PLY files of PlayCanvas, read with the package gaussforge.

The format is deprecated, so crossgrad does not write it.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, vertex_properties
from crossgrad_plugins.exporters.file_units import bytes_of
from crossgrad_plugins.exporters.ply_cloud import REST, SplatCloud


def is_compressed(path: Path) -> bool:
    """Return True if the header of a PLY file has the fields of a compressed PLY.

    Raises:
        UserError: The file is missing or is not a PLY file.
    """
    return "packed_position" in vertex_properties(path)


def read_compressed(path: Path) -> SplatCloud:
    """Return the Gaussians of a compressed PLY file, in the coordinates of the file.

    Raises:
        UserError: The package gaussforge is missing, or the file is damaged.
    """
    if find_spec("gaussforge") is None:
        raise UserError(
            "compressed PLY files need a package that is not installed",
            where=path,
            expected="the package gaussforge",
            todo="pip install 'crossgrad[formats]', or convert the file to a standard PLY",
        )
    import gaussforge

    answer = gaussforge.GaussForge().read(bytes_of(path), "compressed.ply")
    data = answer.get("data", {})
    tables = {name: _table(data.get(name, b"")) for name in _TABLES}
    count = int(data.get("numPoints", 0))
    finite = all(np.isfinite(table).all() for table in tables.values())
    if not count or not finite or tables["positions"].shape != (count * 3,):
        raise UserError(
            "the compressed PLY file cannot be read",
            where=path,
            found=str(answer.get("error", "numbers that are not finite")),
            todo="copy, download or export the file again",
        )
    sh_rest = np.zeros((count, REST, 3), dtype=np.float32)
    bands = tables["sh"].reshape(count, -1, 3)
    sh_rest[:, : bands.shape[1]] = bands
    return SplatCloud(
        means=tables["positions"].reshape(count, 3).astype(np.float64),
        log_scales=tables["scales"].reshape(count, 3),
        quats=tables["rotations"].reshape(count, 4),
        logit_opacities=tables["alphas"],
        sh_dc=tables["colors"].reshape(count, 3),
        sh_rest=sh_rest,
    )


#: The tables that gaussforge returns, float32.
_TABLES = ("positions", "scales", "rotations", "alphas", "colors", "sh")


def _table(content: bytes) -> NDArray[np.float32]:
    return np.frombuffer(content, dtype="<f4").astype(np.float32)
