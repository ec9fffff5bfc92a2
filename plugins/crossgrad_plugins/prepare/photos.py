"""The photos of a folder: those that can be used, with what their files say, and the others."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_core.commands import UserError
from crossgrad_core.scene.headers import read_header
from crossgrad_core.scene.photo_files import walked
from crossgrad_core.scene.pillow import opened
from crossgrad_plugins.prepare.exif import camera_of, orientation_of, position_of
from crossgrad_plugins.prepare.plan import LeftOut, Photo, Settings

if TYPE_CHECKING:
    from PIL.Image import Image

#: Photo files that pycolmap reads, and others that cameras and editors write.
_READ: Final = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff"})
_UNREAD: Final = frozenset(
    {".arw", ".avif", ".cr2", ".cr3", ".dng", ".gif", ".heic", ".heif", ".jp2", ".jxl", ".nef",
     ".orf", ".psd", ".raf", ".rw2", ".webp"}
)  # fmt: skip
_MASKS: Final = "masks"
_MASK_ENDS: Final = ("_mask", ".mask")
_SMALLEST: Final = 64
#: Photos are looked at with their longest side at about so many pixels.
_LOOKED_AT: Final = 1024
_AT_ONCE: Final = 4
_CHUNK: Final = 1 << 20

Tell = Callable[[int, int], None]


def find_photos(
    root: Path, settings: Settings, tell: Tell
) -> tuple[tuple[Photo, ...], tuple[LeftOut, ...]]:
    """All photos below a folder, by name, and the files that cannot be used.

    Every photo is decoded at a reduced size, so that damaged ones are known before they cost more.

    Args:
        root: The folder.
        settings: Where masks are, and which photos share a calibration.
        tell: Told how many photos of how many are looked at.

    Raises:
        UserError: There is no such folder, or fewer than two photos in it can be used.
    """
    _check_folder(root)
    names, left_out = _listed(root)
    masks = _Masks(root, settings.masks)
    used: list[Photo] = []
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        looks = pool.map(lambda name: _looked_at(root, name, masks, settings.cameras), names)
        for done, found in enumerate(looks, 1):
            (used if isinstance(found, Photo) else left_out).append(found)  # type: ignore[arg-type]
            tell(done, len(names))
    used, doubles = _without_doubles(used)
    left_out += doubles
    if len(used) < 2:  # noqa: PLR2004 - a pose needs a second photo
        raise _too_few(root, used, left_out)
    return tuple(used), tuple(sorted(left_out, key=lambda each: each.name))


def has_photos(root: Path) -> bool:
    """Whether photos lie in a folder, or in those below it."""
    return any(Path(name).suffix.lower() in _READ for name in _names(root))


def _check_folder(root: Path) -> None:
    if not root.is_dir():
        raise UserError(
            "there is no such folder of photos" if not root.exists() else "photos are in a folder",
            where=root,
            expected="a folder with photos",
            found="a file" if root.exists() else "",
            todo="check the path",
        )


def _names(root: Path) -> Iterator[str]:
    """Paths of all files below a folder, sorted in each folder; hidden ones are left out."""
    for below, folders, files in walked(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = PurePosixPath(below)
        yield from ((here / file).as_posix() for file in sorted(files) if file[0] != ".")


def _listed(root: Path) -> tuple[list[str], list[LeftOut]]:
    """Names of the photo files, and those that cannot be read here."""
    names, left_out = [], []
    for name in _names(root):
        path = PurePosixPath(name)
        if path.parts[0] == _MASKS or path.stem.lower().endswith(_MASK_ENDS):
            continue
        suffix = path.suffix.lower()
        if suffix in _UNREAD:
            what = suffix[1:].upper()
            left_out.append(LeftOut(name=_shown(name), why=f"{what} cannot be read: save as JPEG"))
        elif suffix in _READ and not _is_text(name):
            left_out.append(LeftOut(name=_shown(name), why="its name is not UTF-8: rename it"))
        elif suffix in _READ:
            names.append(name)
    return sorted(names), left_out


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return "\n" not in name


def _shown(name: str) -> str:
    return name.encode(errors="replace").decode()


def _looked_at(root: Path, name: str, masks: "_Masks", cameras: str) -> Photo | LeftOut:
    """The photo, or why it cannot be used."""
    path = root / name
    try:
        header = read_header(path)
        if min(header.width, header.height) < _SMALLEST:
            return LeftOut(name=name, why=f"too small: {header.width} x {header.height} pixels")
        with opened(path, "the photo cannot be decoded") as image:
            camera, position = camera_of(image), position_of(image)
            orientation = orientation_of(image)
            brightness, sharpness = _look(image)
        folder = name.rpartition("/")[0]
        size = f"{header.width} x {header.height}"
        return Photo(
            name=name,
            folder=folder,
            width=header.width,
            height=header.height,
            orientation=orientation,
            camera=name if cameras == "photo" else f"{folder}: {size} {camera}".strip(),
            position=position,
            mask=masks.of(name),
            brightness=brightness,
            sharpness=sharpness,
            bytes=path.stat().st_size,
            sha256=_digest(path),
        )
    except UserError as error:
        return LeftOut(
            name=name, why=f"{error.what} ({error.found})" if error.found else error.what
        )
    except OSError as error:
        return LeftOut(name=name, why=error.strerror or str(error))


def _look(image: "Image") -> tuple[float, float]:
    """Mean of the grey levels, and mean square of their Laplacian at a reduced size."""
    longest = max(image.size)
    image.draft("L", (image.width * _LOOKED_AT // longest, image.height * _LOOKED_AT // longest))
    small = image.convert("RGB").convert("L")
    small.thumbnail((_LOOKED_AT, _LOOKED_AT))
    grey = np.asarray(small, dtype=np.float64)
    inner = grey[1:-1, 1:-1]
    curve = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4.0 * inner
    return round(float(grey.mean()), 2), round(float((curve**2).mean()), 2)


def _digest(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            found.update(chunk)
    return found.hexdigest()


class _Masks:
    """The masks of photos.

    Args:
        root: Folder of the photos.
        wanted: Folder of the masks; None for `masks/` below the photos, and files beside them.
    """

    def __init__(self, root: Path, wanted: str | None) -> None:
        self._root = root
        self._folder = root / _MASKS if wanted is None else Path(wanted)
        self._beside = wanted is None
        if wanted is not None and not self._folder.is_dir():
            raise UserError(
                "the mask folder is not there",
                where=wanted,
                todo="check the path, or leave --masks out",
            )

    def of(self, name: str) -> str | None:
        """Path of the mask of a photo: `x.jpg.png`, `x.png`, `x_mask.png` or `x.jpg`."""
        stem = str(PurePosixPath(name).with_suffix(""))
        places = [self._folder / each for each in
                  (f"{name}.png", f"{stem}.png", f"{stem}_mask.png", name)]  # fmt: skip
        if self._beside:
            places += [self._root / f"{stem}{end}.png" for end in _MASK_ENDS]
        return next((str(path.absolute()) for path in places if path.is_file()), None)


def _without_doubles(photos: Sequence[Photo]) -> tuple[list[Photo], list[LeftOut]]:
    """The photos without those whose file another one has, too; the first of each stays."""
    first: dict[str, Photo] = {}
    for photo in photos:
        first.setdefault(photo.sha256, photo)
    kept = [photo for photo in photos if first[photo.sha256] is photo]
    doubles = [
        LeftOut(name=photo.name, why=f"the same file as {first[photo.sha256].name}")
        for photo in photos
        if first[photo.sha256] is not photo
    ]
    return kept, doubles


def _too_few(root: Path, used: Sequence[Photo], left_out: Sequence[LeftOut]) -> UserError:
    """The error where no scene can be made."""
    first = "; ".join(f"{each.name}: {each.why}" for each in left_out[:3])
    nothing = not used and not left_out
    todo = "name the folder that the photos are in"
    if left_out:
        todo = "repair, convert or leave out what is named, or name another folder"
    elif used:
        todo = "add photos that overlap with it, taken from other places"
    return UserError(
        "there are no photos in the folder" if nothing else "too few photos can be used",
        where=root,
        expected=f"at least 2 photos ({', '.join(sorted(end[1:] for end in _READ))})",
        found=f"{len(used)} that can be used" + (f"; {first}" if first else ""),
        todo=todo,
    )
