"""Functions that tell which reader accepts a folder; they do not import the readers.

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

#: The pose file of NeRF synthetic scenes.
BLENDER_FILE: Final = "transforms_train.json"
#: The pose file of nerfstudio and of a MatrixCity block, and the key that only MatrixCity uses.
TRANSFORMS_FILE: Final = "transforms.json"
_ROTATION: Final = b'"rot_mat"'
#: Folders that are searched for blocks, and the maximum depth of the search. An example is
#: small_city/aerial/train/block_1.
_BLOCKS: Final = re.compile(r"aerial|street|train|test|(block|small_city|big_city|bridge).*")
_DEEPEST: Final = 4
#: The reconstruction of OpenSfM, and the reconstruction in an OpenDroneMap project.
OPENSFM_FILES: Final = ("reconstruction.json", "opensfm/reconstruction.json")
#: Columns of RealityCapture's CSV.
NAME_COLUMN: Final = "name"
POSE_COLUMNS: Final = ("x", "y", "alt", "heading", "pitch", "roll")
COLUMNS: Final = frozenset({NAME_COLUMN, *POSE_COLUMNS, "f"})
#: If a file has at least this many of the columns, it is probably meant as a RealityCapture CSV.
_NEARLY: Final = 5
#: Names in UC-GS scenes: the prefix of a folder of held-out photos, and the word in the names of
#: held-out photos.
_TEST: Final = "test"
_EVAL: Final = re.compile(r"(?<![a-z])eval(?![a-z])")
#: Maximum number of photo names that are read to recognise a UC-GS scene.
_MOST: Final = 10_000


def blender(path: Path, folder: str = ".") -> bool:
    """Return True if the folder holds a NeRF synthetic scene."""
    return begins_with(path / folder / BLENDER_FILE, b"{")


def colmap(path: Path) -> bool:
    """Return True if the folder holds a COLMAP model."""
    try:
        return bool(find_models(path))
    except OSError:
        return False


def matrixcity(path: Path) -> bool:
    """Return True if the folder is a MatrixCity block or contains such blocks."""
    return any(holds(path / name, _ROTATION) for name in pose_files(path))


def metashape(path: Path, file: str | None = None) -> bool:
    """Return True if the folder holds a Metashape XML file of cameras."""
    return bool(METASHAPE.find(Inside(path), file))


def nerfstudio(path: Path, file: str = TRANSFORMS_FILE) -> bool:
    """Return True if the folder holds a frames file of nerfstudio or instant-ngp."""
    return begins_with(path / file, b"{") and not holds(path / file, _ROTATION)


def opensfm(path: Path, names: Sequence[str] = OPENSFM_FILES) -> bool:
    """Return True if the folder holds an OpenSfM reconstruction."""
    return any(begins_with(path / name, b"[") for name in names)


def photos_alone(path: Path) -> bool:  # noqa: ARG001 - the answer does not depend on the folder
    """Return False: only `--prepare` reads a folder this way."""
    return False


def realitycapture(path: Path, file: str | None = None) -> bool:
    """Return True if the folder holds a RealityCapture CSV of camera parameters."""
    return bool(REALITYCAPTURE.find(Inside(path), file))


def uc_gs(path: Path, images: str = "images") -> bool:
    """Return True if the folder holds a COLMAP model with photo names that mark held-out photos."""
    return colmap(path) and any(map(is_held_out, _photos_below(path / images)))


def pose_files(scene: Path) -> list[str]:
    """Return the scene's own pose file if there is one, else the pose files of all blocks."""
    names = [path.relative_to(scene).as_posix() for path in _walk(scene, 0)]
    return [TRANSFORMS_FILE] if TRANSFORMS_FILE in names else sorted(names)


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the pose files in a folder and in subfolders that can belong to MatrixCity."""
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
    """Return True if UC-GS holds out a photo with this name."""
    path = PurePosixPath(name)
    folders = (folder.lower() for folder in path.parts[:-1])
    named = _EVAL.search(path.name.lower()) is not None
    return named or any(folder.startswith(_TEST) for folder in folders)


def _photos_below(images: Path) -> Iterator[str]:
    """Yield names of photos in a folder, at most two folders deep and at most `_MOST` names."""
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
    """A kind of camera file.

    Attributes:
        form: Format of the file, such as XML.
        program: Program that writes the file.
        suffix: Suffix of the file name, with the dot.
        holds: Function that returns whether a file is of this kind, from the first bytes of the
            file.
        expected: Description of a correct file, for error messages.
        nearly: Function that returns whether a file is almost of this kind.
    """

    form: str
    program: str
    suffix: str
    holds: Callable[[Path], bool]
    expected: str
    nearly: Callable[[Path], bool] = lambda _: False

    def find(self, inside: Inside, named: str | None) -> list[Path]:
        """Return the files of this kind: only the named file, or all in the scene's own folder."""
        files = self._files(inside) if named is None else [inside.scene / named]
        return list(filter(self.holds, files))

    def find_near(self, inside: Inside) -> list[Path]:
        """Return the files in the scene's own folder that are almost of this kind."""
        return list(filter(self.nearly, self._files(inside)))

    def _files(self, inside: Inside) -> list[Path]:
        return [path for path in inside.files("*") if path.suffix.lower() == self.suffix]

    def one(self, inside: Inside, named: str | None) -> Path:
        """Return the file named by `reader.file`, else the only file (almost) of this kind.

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
