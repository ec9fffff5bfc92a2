"""Which reader accepts a folder, answered without importing the readers.

The entry points of the group `crossgrad.readers.accepts` name these functions.
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

#: The poses of NeRF synthetic scenes.
BLENDER_FILE: Final = "transforms_train.json"
#: The poses of nerfstudio and of a block of MatrixCity, and the key that only MatrixCity has.
TRANSFORMS_FILE: Final = "transforms.json"
_ROTATION: Final = b'"rot_mat"'
#: Folders in which blocks are looked for, and how deep: such as small_city/aerial/train/block_1.
_BLOCKS: Final = re.compile(r"aerial|street|train|test|(block|small_city|big_city|bridge).*")
_DEEPEST: Final = 4
#: The reconstruction of OpenSfM, and that of a project of OpenDroneMap.
OPENSFM_FILES: Final = ("reconstruction.json", "opensfm/reconstruction.json")
#: Columns of RealityCapture's CSV.
NAME_COLUMN: Final = "name"
POSE_COLUMNS: Final = ("x", "y", "alt", "heading", "pitch", "roll")
COLUMNS: Final = frozenset({NAME_COLUMN, *POSE_COLUMNS, "f"})
#: A file with this many of the columns is meant to be one of RealityCapture.
_NEARLY: Final = 5
#: Names of UC-GS: how a folder of held-out photos begins, and the word in a held-out photo's name.
_TEST: Final = "test"
_EVAL: Final = re.compile(r"(?<![a-z])eval(?![a-z])")
#: Photos that are looked at to recognise a scene of UC-GS.
_MOST: Final = 10_000


def blender(path: Path, folder: str = ".") -> bool:
    """Return whether the folder holds a NeRF synthetic scene."""
    return begins_with(path / folder / BLENDER_FILE, b"{")


def colmap(path: Path) -> bool:
    """Return whether the folder holds a COLMAP model."""
    try:
        return bool(find_models(path))
    except OSError:
        return False


def matrixcity(path: Path) -> bool:
    """Return whether the folder holds a block of MatrixCity, or blocks below it."""
    return any(holds(path / name, _ROTATION) for name in pose_files(path))


def metashape(path: Path, file: str | None = None) -> bool:
    """Return whether the folder holds Metashape's XML of cameras."""
    return bool(METASHAPE.find(Inside(path), file))


def nerfstudio(path: Path, file: str = TRANSFORMS_FILE) -> bool:
    """Return whether the folder holds the frames of nerfstudio or instant-ngp."""
    return begins_with(path / file, b"{") and not holds(path / file, _ROTATION)


def opensfm(path: Path, names: Sequence[str] = OPENSFM_FILES) -> bool:
    """Return whether the folder holds a reconstruction of OpenSfM."""
    return any(begins_with(path / name, b"[") for name in names)


def photos_alone(path: Path) -> bool:  # noqa: ARG001 - no folder is prepared unasked
    """Return False: only `--prepare` reads a folder this way."""
    return False


def realitycapture(path: Path, file: str | None = None) -> bool:
    """Return whether the folder holds RealityCapture's CSV of camera parameters."""
    return bool(REALITYCAPTURE.find(Inside(path), file))


def uc_gs(path: Path, images: str = "images") -> bool:
    """Return whether the folder holds a COLMAP model whose photo names tell what is held out."""
    return colmap(path) and any(map(is_held_out, _photos_below(path / images)))


def pose_files(scene: Path) -> list[str]:
    """Names of the pose files of all blocks; that of the scene's own folder alone, if any."""
    found = [path.relative_to(scene).as_posix() for path in _walk(scene, 0)]
    return [TRANSFORMS_FILE] if TRANSFORMS_FILE in found else sorted(found)


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    """The pose files in a folder and in those below that may be of this data set."""
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
    """Return whether UC-GS holds out a photo of this name."""
    path = PurePosixPath(name)
    folders = (folder.lower() for folder in path.parts[:-1])
    named = _EVAL.search(path.name.lower()) is not None
    return named or any(each.startswith(_TEST) for each in folders)


def _photos_below(images: Path) -> Iterator[str]:
    """Names of photos below a folder, in two folders at most; the first many of them."""
    found = (path for pattern in ("*.*", "*/*.*", "*/*/*.*") for path in images.glob(pattern))
    try:
        for _, path in zip(range(_MOST), found, strict=False):
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
    """A kind of file.

    Attributes:
        form: Such as XML.
        program: Whose it is.
        suffix: Of its names, with the dot.
        holds: Whether a file is of the kind, from its first bytes.
        expected: What is in it, for errors.
        nearly: Whether a file lacks little to be of the kind.
    """

    form: str
    program: str
    suffix: str
    holds: Callable[[Path], bool]
    expected: str
    nearly: Callable[[Path], bool] = lambda _: False

    def find(self, inside: Inside, named: str | None) -> list[Path]:
        """The files of the kind: at most the named one, else those of the scene's own folder."""
        files = self._files(inside) if named is None else [inside.scene / named]
        return list(filter(self.holds, files))

    def find_near(self, inside: Inside) -> list[Path]:
        """The files of the scene's own folder that lack little to be of the kind."""
        return list(filter(self.nearly, self._files(inside)))

    def _files(self, inside: Inside) -> list[Path]:
        return [path for path in inside.files("*") if path.suffix.lower() == self.suffix]

    def one(self, inside: Inside, named: str | None) -> Path:
        """The file that is named by `reader.file`, else the only one of the kind, or nearly.

        Raises:
            UserError: There is none, or there are several, or it leads out of the scene.
        """
        if named is not None:
            return inside.file(inside.name(named, "reader.file"), "reader.file")
        found = self.find(inside, None) or self.find_near(inside)
        if len(found) == 1:
            return inside.file(found[0].name, found[0])
        several = f"several {self.form}s" if found else f"no {self.form}"
        raise UserError(
            f"the scene has {several} of {self.program}",
            where=inside.scene,
            expected=self.expected,
            found=", ".join(path.name for path in found) or "none",
            todo="name it, with --set reader.file=NAME, or export it",
        )


METASHAPE: Final = Kind(
    *("XML", "Metashape", ".xml", _is_metashape),
    "one file of File > Export > Export Cameras, with a chunk in a document",
)
REALITYCAPTURE: Final = Kind(
    *("CSV", "RealityCapture", ".csv", _has_columns),
    f"one file with the columns #{NAME_COLUMN}, {', '.join((*POSE_COLUMNS, 'f'))} ...",
    _has_most_columns,
)
