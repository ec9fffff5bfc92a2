"""The photos of a folder: usable photos with metadata, and files that cannot be used."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from math import isfinite
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_core.commands import UserError
from crossgrad_core.scene.photos import pillow
from crossgrad_core.scene.photos.headers import PhotoHeader, read_header
from crossgrad_core.scene.photos.photo_files import walked
from crossgrad_core.scene.photos.pillow import opened
from crossgrad_core.scene.raw import is_possible_name
from crossgrad_core.scene.wording import megapixels, name_some
from crossgrad_plugins.georeference.gps_tags import gps_of, is_place
from crossgrad_plugins.prepare.masks import HALF, sorted_out, with_mask
from crossgrad_plugins.prepare.plan import LeftOut, Photo, Position, Settings, digest_of

if TYPE_CHECKING:
    from PIL.Image import Image


_EXIF, _ORIENTATION = 0x8769, 0x0112
_ORIENTATIONS: Final = range(1, 9)
_MAKE, _MODEL, _FOCAL, _FOCAL_35 = 0x010F, 0x0110, 0x920A, 0xA405


def camera_of(image: "Image") -> str:
    """Return make, model and focal length from EXIF; they are equal for photos with equal zoom."""
    header = image.getexif()
    details = header.get_ifd(_EXIF)
    parts = [header.get(_MAKE), header.get(_MODEL), _number(details.get(_FOCAL)),
             _number(details.get(_FOCAL_35))]  # fmt: skip
    return " ".join(str(part).strip("\0 ") for part in parts if part is not None)


def orientation_of(image: "Image") -> int:
    """Return the photo's EXIF orientation, 1 to 8; 1 if it is missing."""
    orientation = image.getexif().get(_ORIENTATION)
    return orientation if isinstance(orientation, int) and orientation in _ORIENTATIONS else 1


def position_of(image: "Image") -> Position | None:
    """Return the photo's GPS position, or None if it is missing or invalid."""
    latitude, longitude, altitude = gps_of(image)
    if not is_place(latitude, longitude) or not isfinite(altitude):
        return None
    return Position(latitude=latitude, longitude=longitude, altitude=altitude)


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if isfinite(number) else None


#: Suffixes of photo files that pycolmap reads, and of other files that cameras and editors write.
_READ: Final = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff"})
_UNREAD: Final = frozenset(
    {".arw", ".avif", ".cr2", ".cr3", ".dng", ".gif", ".heic", ".heif", ".jp2", ".jxl", ".nef",
     ".orf", ".psd", ".raf", ".rw2", ".webp"}
)  # fmt: skip
_KNOWN: Final = _READ | _UNREAD
_IMPOSSIBLE: Final = (
    "its name has control characters or backslashes, is too long or is not UTF-8: rename it"
)
_SMALLEST: Final = 64
#: For JPEG files, which can be decoded at reduced size, the maximum number of pixels is multiplied
#: by this factor. Phones take photos of 200 megapixels.
_REDUCIBLE: Final = 2
#: Approximate longest side, in pixels, of the reduced photos that are inspected.
_LOOKED_AT: Final = 1024
_AT_ONCE: Final = 4
#: Photos above a fixed share of the maximum size count as large. The lock makes sure that only one
#: large photo is decoded at a time.
_LARGE: Final = Lock()
Tell = Callable[[int, int], None]


def find_photos(
    root: Path, settings: Settings, tell: Tell, fewest: int = 2
) -> tuple[tuple[Photo, ...], tuple[LeftOut, ...]]:
    """Return all usable photos below a folder, sorted by name, and the unusable files.

    Every photo is decoded at a reduced size, so that damaged photos are found early.

    Args:
        root: Folder of the photos.
        settings: Settings that give the mask folder, and the photos that share a calibration.
        tell: Function that gets the number of inspected photos and the number of all photos.
        fewest: Minimum number of photos. At least two photos are needed for a pose.

    Raises:
        UserError: The folder is missing or contains too few usable photos, a photo is too large, or
            a mask is damaged or does not fit.
    """
    _check_folder(root)
    wanted = None if settings.masks is None else Path(settings.masks)
    for folder in filter(None, (root.resolve(), wanted)):
        _check_text(folder)
    files = [name for name in _names(root) if PurePosixPath(name).suffix.lower() in _KNOWN]
    sorted_files = sorted_out(root, files, wanted)
    names, left_out = _listed(sorted_files.photos)
    left_out += sorted_files.left_out
    used: list[Photo] = []
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        looks = pool.map(
            lambda name: _looked_at(root, name, sorted_files.masks.get(name), settings.cameras),
            names,
        )
        for done, inspected in enumerate(looks, 1):
            (used if isinstance(inspected, Photo) else left_out).append(inspected)  # type: ignore[arg-type]
            tell(done, len(names))
    used, doubles = _without_doubles(used)
    left_out += doubles
    if len(used) < fewest:
        raise _too_few(root, used, left_out)
    return tuple(used), tuple(sorted(left_out, key=lambda unusable: unusable.name))


def has_photos(root: Path) -> bool:
    """Return True if a folder or its subfolders contain photos."""
    return any(Path(name).suffix.lower() in _READ for name in _names(root))


def _check_folder(root: Path) -> None:
    if not root.is_dir():
        raise UserError(
            "the photo folder does not exist"
            if not root.exists()
            else "the path of the photos must be a folder",
            where=root,
            expected="a folder with photos",
            found="a file" if root.exists() else "",
            todo="check the path",
        )


def _check_text(folder: Path) -> None:
    """Refuse a folder whose name cannot be stored in the plan."""
    try:
        str(folder).encode()
    except UnicodeEncodeError as error:
        raise UserError(
            "the name of the folder is not valid text",
            where=folder,
            expected="a path in UTF-8",
            todo="rename it",
        ) from error


def _names(root: Path) -> Iterator[str]:
    """Yield the paths of all files below a folder, sorted by name, without hidden files."""
    for below, folders, files in walked(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = PurePosixPath(below)
        yield from ((here / file).as_posix() for file in sorted(files) if file[0] != ".")


#: Pillow's names of TIFF pixel modes that photos do not have.
_MODES_OF_TIFF: Final = ("I", "1")
_VALUES: Final = {"F": "floating point", "I": "32 bits", "1": "1 bit"}


def _listed(names: Iterable[str]) -> tuple[list[str], list[LeftOut]]:
    """Return the names of usable photos, and the files with unusable names."""
    usable, left_out = [], []
    for name in names:
        suffix = PurePosixPath(name).suffix.lower()
        if suffix in _UNREAD:
            what = suffix[1:].upper()
            left_out.append(LeftOut(name=_shown(name), why=f"{what} cannot be read: save as JPEG"))
        # Test the name of the photo's mask too; it is the photo's name with a further suffix.
        # COLMAP models that were made on Windows contain backslashes.
        elif "\\" in name or not is_possible_name(f"{name}.png"):
            left_out.append(LeftOut(name=_shown(name), why=_IMPOSSIBLE))
        else:
            usable.append(name)
    return sorted(usable), left_out


def _shown(name: str) -> str:
    return name_some([name])


def _looked_at(root: Path, name: str, mask: Path | None, cameras: str) -> Photo | LeftOut:
    """Return the photo, or the reason why it cannot be used.

    Raises:
        UserError: The photo is too large, or its mask does not fit.
    """
    path = root / name
    try:
        header = read_header(path)
    except (UserError, OSError) as error:
        return LeftOut(name=name, why=_reason(error))
    pixels = header.width * header.height
    if min(header.width, header.height) < _SMALLEST:
        return LeftOut(name=name, why=f"too small: {header.width} x {header.height} pixels")
    if pixels > _most_pixels(header):
        raise _too_large(path, header)
    with _LARGE if pixels > pillow.MOST_PIXELS // _AT_ONCE else nullcontext():
        try:
            photo = _read(root, name, header, cameras)
        except (UserError, OSError) as error:
            return LeftOut(name=name, why=_reason(error))
        return photo if mask is None else with_mask(photo, mask)


def _read(root: Path, name: str, header: PhotoHeader, cameras: str) -> Photo:
    """Return the photo without its mask.

    Raises:
        UserError: The photo cannot be decoded.
        OSError: The file cannot be read.
    """
    path = root / name
    with opened(path, "the photo cannot be decoded") as image:
        if image.mode == "F" or (image.format == "TIFF" and image.mode in _MODES_OF_TIFF):
            # COLMAP would write the undistorted photo in a format that no program can read.
            raise UserError(
                "the pixel values of the photo have a type that photos do not use",
                where=path,
                expected="8 or 16 bits",
                found=f"{image.format}, {_VALUES[image.mode]}",
                todo="save it as JPEG or PNG",
            )
        camera, position = camera_of(image), position_of(image)
        orientation = orientation_of(image)
        brightness, sharpness, transparent = _look(image, header)
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
        transparent=transparent,
        brightness=brightness,
        sharpness=sharpness,
        bytes=path.stat().st_size,
        sha256=digest_of(path),
    )


def _reason(error: UserError | OSError) -> str:
    """Return the reason why a photo cannot be used."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return f"{error.what} ({error.found})" if error.found else error.what


def _look(image: "Image", header: PhotoHeader) -> tuple[float, float, bool]:
    """Return brightness (mean grey level), sharpness (mean squared Laplacian) and transparency."""
    longest = max(image.size)
    image.draft("L", (image.width * _LOOKED_AT // longest, image.height * _LOOKED_AT // longest))
    # Skip photos with more than 8 bits per channel, because training ignores their transparency.
    transparent = False
    if header.alpha and not image.mode.startswith(("I", "F")):
        least, _ = image.convert("RGBA").getchannel("A").getextrema()
        transparent = int(least) < HALF  # type: ignore[arg-type]
    small = (image if image.mode in {"L", "RGB"} else image.convert("RGB")).convert("L")
    small.thumbnail((_LOOKED_AT, _LOOKED_AT))
    grey = np.asarray(small, dtype=np.float64)
    inner = grey[1:-1, 1:-1]
    curve = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4.0 * inner
    return round(float(grey.mean()), 2), round(float((curve**2).mean()), 2), transparent


def _most_pixels(header: PhotoHeader) -> int:
    """Return the maximum number of pixels of a photo.

    It is limited because COLMAP decodes photos at full size.
    """
    return pillow.MOST_PIXELS * (_REDUCIBLE if header.reducible else 1)


def _too_large(path: Path, header: PhotoHeader) -> UserError:
    limit, most = megapixels(pillow.MOST_PIXELS), megapixels(_REDUCIBLE * pillow.MOST_PIXELS)
    pixels = megapixels(header.width * header.height)
    return UserError(
        "the photo is too large to be decoded",
        where=path,
        expected=f"at most {limit}, or {most} for a JPEG file that is not progressive",
        found=f"{header.width} x {header.height} pixels, {pixels}",
        todo="save it at a smaller size, such as half its width and height, or remove it "
        "from the folder (--max-size applies only after decoding)",
    )


def _without_doubles(photos: Sequence[Photo]) -> tuple[list[Photo], list[LeftOut]]:
    """Return the photos without copies of a file; the first of several equal files is kept."""
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
    """Return the error for too few usable photos."""
    first = "; ".join(f"{unusable.name}: {unusable.why}" for unusable in left_out[:3])
    nothing = not used and not left_out
    todo = "name the folder that contains the photos"
    if left_out:
        todo = "repair, convert or remove these photos, or name another folder"
    elif used:
        todo = "add photos that overlap with it, taken from other positions"
    return UserError(
        "the folder contains no photos" if nothing else "too few photos can be used",
        where=root,
        expected=f"at least 2 photos ({', '.join(sorted(end[1:] for end in _READ))})",
        found=f"{len(used)} usable photos" + (f"; {first}" if first else ""),
        todo=todo,
    )
