"""Compressed PLY files of PlayCanvas, read with the package gaussforge.

The format is deprecated, so crossgrad does not write it.
"""

from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from crossgrad_core.plugin import UserError, vertex_properties
from crossgrad_plugins.exporters.file_units import bytes_of
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import read_ply


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

    # `GaussForge.read` fails for files without spherical harmonics, so convert the file.
    answer = gaussforge.GaussForge().convert(bytes_of(path), "compressed.ply", "ply")
    try:
        with TemporaryDirectory() as folder:
            standard = Path(folder) / "standard.ply"
            standard.write_bytes(answer.get("data", b""))
            return read_ply(standard)
    except UserError as error:
        raise UserError(
            "the compressed PLY file cannot be read",
            where=path,
            found=str(answer.get("error") or error.found or error.what),
            todo="copy, download or export the file again",
        ) from error
