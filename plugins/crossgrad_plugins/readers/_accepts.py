"""Functions that decide which reader accepts a folder, without an import of the readers.

These functions are the entry points of the group `crossgrad.readers.accepts`.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.plugin import UserError
from crossgrad_plugins.readers._columns import Columns, begins_with, head_of, holds
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers.colmap_files.folder import find_models

#: The pose file of NeRF synthetic scenes.
BLENDER_FILE: Final = "transforms_train.json"
#: The pose file of nerfstudio and of a MatrixCity block, and the key that only MatrixCity uses.
TRANSFORMS_FILE: Final = "transforms.json"
_ROTATION: Final = b'"rot_mat"'
#: Folders that are searched for blocks, such as small_city/aerial/train/block_1, and the maximum
#: depth of the search.
_BLOCKS: Final = re.compile(r"aerial|street|train|test|(block|small_city|big_city|bridge).*")
_DEEPEST: Final = 4
#: Paths of the reconstruction in an OpenSfM folder and in an OpenDroneMap project.
OPENSFM_FILES: Final = ("reconstruction.json", "opensfm/reconstruction.json")
#: Columns of RealityCapture's CSV.
NAME_COLUMN: Final = "name"
POSE_COLUMNS: Final = ("x", "y", "alt", "heading", "pitch", "roll")
COLUMNS: Final = frozenset({NAME_COLUMN, *POSE_COLUMNS, "f"})
#: A file with at least this many of the columns counts as an incomplete RealityCapture CSV, and
#: gets a helpful error.
_NEARLY: Final = 5
#: Names in UC-GS scenes: the prefix of folders of held-out photos, and a word in the names of
#: held-out photos.
_TEST: Final = "test"
_EVAL: Final = re.compile(r"(?<![a-z])eval(?![a-z])")
#: Maximum number of photo names that are read to recognise a UC-GS scene.
_MOST: Final = 10_000


def blender(path: Path, folder: str = ".") -> bool:
    """Return True if the folder contains a NeRF synthetic scene."""
    return begins_with(path / folder / BLENDER_FILE, b"{")


def colmap(path: Path) -> bool:
    """Return True if the folder contains a COLMAP model."""
    try:
        return bool(find_models(path))
    except OSError:
        return False


def matrixcity(path: Path) -> bool:
    """Return True if the folder is a MatrixCity block or contains MatrixCity blocks."""
    return any(holds(path / name, _ROTATION) for name in pose_files(path))


def metashape(path: Path, file: str | None = None) -> bool:
    """Return True if the folder contains Metashape's XML file of cameras."""
    return bool(METASHAPE.find(Inside(path), file))


def nerfstudio(path: Path, file: str = TRANSFORMS_FILE) -> bool:
    """Return True if the folder contains a frames file of nerfstudio or instant-ngp."""
    return begins_with(path / file, b"{") and not holds(path / file, _ROTATION)


def opensfm(path: Path, names: Sequence[str] = OPENSFM_FILES) -> bool:
    """Return True if the folder contains an OpenSfM reconstruction."""
    return any(begins_with(path / name, b"[") for name in names)


def photos_alone(path: Path) -> bool:  # noqa: ARG001 - the answer does not depend on the folder
    """Return False, because only the option `--prepare` selects this reader."""
    return False


def realitycapture(path: Path, file: str | None = None) -> bool:
    """Return True if the folder contains a RealityCapture CSV of camera parameters."""
    return bool(REALITYCAPTURE.find(Inside(path), file))


def uc_gs(path: Path, images: str = "images") -> bool:
    """Return True if the folder contains a COLMAP model whose photo names mark held-out photos."""
    return colmap(path) and any(map(is_held_out, _photos_below(path / images)))


def pose_files(scene: Path) -> list[str]:
    """Return the pose file in the scene's folder, or else the pose files of all blocks."""
    names = [path.relative_to(scene).as_posix() for path in _walk(scene, 0)]
    return [TRANSFORMS_FILE] if TRANSFORMS_FILE in names else sorted(names)


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the pose files in a folder, and in subfolders whose names MatrixCity uses."""
    try:
        inner = [path for path in folder.iterdir() if _BLOCKS.fullmatch(path.name)]
    except OSError:
        return
    if (folder / TRANSFORMS_FILE).is_file():
        yield folder / TRANSFORMS_FILE
    for path in inner:
        if depth < _DEEPEST and path.is_dir() and not path.is_symlink():
            yield from _walk(path, depth + 1)


def is_held_out(name: str) -> bool:
    """Return True if a photo with this name is held out in UC-GS scenes."""
    path = PurePosixPath(name)
    folders = (folder.lower() for folder in path.parts[:-1])
    named = _EVAL.search(path.name.lower()) is not None
    return named or any(folder.startswith(_TEST) for folder in folders)


def _photos_below(images: Path) -> Iterator[str]:
    """Yield at most `_MOST` names of photos in a folder, at most two folders deep."""
    paths = (path for pattern in ("*.*", "*/*.*", "*/*/*.*") for path in images.glob(pattern))
    try:
        for _, path in zip(range(_MOST), paths, strict=False):
            yield path.relative_to(images).as_posix()
    except OSError:
        return


def _is_metashape(path: Path) -> bool:
    head = head_of(path)
    return b"<document" in head and b"<chunk" in head


def _has_columns(path: Path) -> bool:
    return {*Columns.of(path, COLUMNS).names} >= COLUMNS


def _has_most_columns(path: Path) -> bool:
    return len(COLUMNS & {*Columns.of(path, COLUMNS).names}) >= _NEARLY


@dataclass(frozen=True)
class Kind:
    """A kind of file with camera parameters.

    Attributes:
        form: Format of the file, such as XML.
        program: Name of the program that writes the file.
        suffix: Suffix of the file name, with the dot.
        holds: Function that returns True if the first bytes of a file belong to this kind.
        expected: Description of a correct file, for error messages.
        nearly: Function that returns True if a file is probably meant as this kind but is
            incomplete.
    """

    form: str
    program: str
    suffix: str
    holds: Callable[[Path], bool]
    expected: str
    nearly: Callable[[Path], bool] = lambda _: False

    def find(self, inside: Inside, named: str | None) -> list[Path]:
        """Return the files of this kind: the named file, or all files in the scene's folder."""
        files = self._files(inside) if named is None else [inside.scene / named]
        return list(filter(self.holds, files))

    def find_near(self, inside: Inside) -> list[Path]:
        """Return the files in the scene's folder that are incomplete files of this kind."""
        return list(filter(self.nearly, self._files(inside)))

    def _files(self, inside: Inside) -> list[Path]:
        return [path for path in inside.files("*") if path.suffix.lower() == self.suffix]

    def one(self, inside: Inside, named: str | None) -> Path:
        """Return the file that `reader.file` names, or else the only file of this kind.

        Raises:
            UserError: There is no such file, there are several, or the name leads out of the scene.
        """
        if named is not None:
            return inside.file(inside.name(named, "reader.file"), "reader.file")
        files = self.find(inside, None) or self.find_near(inside)
        if len(files) == 1:
            return inside.file(files[0].name, files[0])
        several = f"several {self.form}s" if files else f"no {self.form}"
        raise UserError(
            f"the scene contains {several} of {self.program}, and it is not clear which "
            "one to read",
            where=inside.scene,
            expected=self.expected,
            found=", ".join(path.name for path in files) or "none",
            todo="name the file, with --set reader.file=NAME, or export it",
        )


METASHAPE: Final = Kind(
    *("XML", "Metashape", ".xml", _is_metashape),
    "one file of File > Export > Export Cameras that contains a chunk in a document",
)
REALITYCAPTURE: Final = Kind(
    *("CSV", "RealityCapture", ".csv", _has_columns),
    f"one file with the columns #{NAME_COLUMN}, {', '.join((*POSE_COLUMNS, 'f'))} ...",
    _has_most_columns,
)
