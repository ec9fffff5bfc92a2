"""A disk cache of photos in their training size, which all runs share.

Each file of the cache (an entry) contains one photo. The name of an entry is a hash of everything
that determines the pixels. An entry never changes, because its name is a hash of the inputs. An
entry is written completely or not at all. Each entry contains a checksum. An invalid entry counts
as missing.
"""

import logging
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from itertools import count
from pathlib import Path
from threading import Lock
from time import time, time_ns
from typing import Final, Protocol
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

_LOG = logging.getLogger(__name__)
#: Environment variable that sets the folder of the cache. Without the variable, the cache is in the
#: user's cache folder.
FOLDER: Final = "CROSSGRAD_CACHE"
#: Increase this number whenever decoding, undistorting or resizing changes any bit of the results.
PIXELS_VERSION: Final = 2
#: Number of bytes that the cache leaves free on the disk.
RESERVE: Final = 2 * 2**30
_MAGIC, _SUM = b"CGphoto1", 4
_KEPT, _TEMPORARY = ".photo", ".tmp"
#: Age in seconds after which an unfinished file counts as left behind by a killed process.
_STALE = 3600.0
#: Possible error of file times, in seconds.
_GRAIN = 2.0
_NUMBER = count()

Decoded = tuple[Tensor, Tensor | None]


class Storable(Protocol):
    """A photo that can be decoded and may be cached on disk."""

    @property
    def target(self) -> tuple[int, int]:
        """Width and height of the training photo."""
        ...

    @property
    def origin(self) -> str | None:
        """Text with everything that determines the pixels.

        The text is None if reading from the cache would save no time.
        """
        ...

    def decode(self) -> Decoded:
        """Return the photo [H, W, 3] uint8 and its mask [H, W] bool.

        The mask is None if all pixels are valid.
        """
        ...


def store_folder() -> Path:
    """Return the folder of the cache: `CROSSGRAD_CACHE`, or a folder in the user's cache folder."""
    if given := os.environ.get(FOLDER):
        return Path(given) / "photos"
    beside = {"darwin": "~/Library/Caches", "win32": os.environ.get("LOCALAPPDATA", "~")}
    base = os.environ.get("XDG_CACHE_HOME") or beside.get(sys.platform, "~/.cache")
    return Path(base).expanduser() / "crossgrad" / "photos"


class PhotoStore:
    """A folder of decoded photos with limited size.

    Several threads and processes may share the folder.

    Entries that were used since this object was created are never deleted. If space is needed, the
    least recently used of all other entries are deleted first. If the deletions do not free enough
    space, or if the disk is full, no more photos are written.

    Args:
        folder: Path of the folder. The folder is created when the first photo is written.
        mib: Largest size of all entries together, in MiB.
    """

    def __init__(self, folder: Path, mib: int) -> None:
        self._folder = folder
        self._limit = mib * 2**20
        self._begun = time() - _GRAIN
        self._used: int | None = None
        # Entry that this object has written or verified -> file time of its last use. If the file
        # time has changed, the entry must be verified again.
        self._sound: dict[Path, int] = {}
        self._lock = Lock()
        self._open = mib > 0

    def holds(self, source: Storable) -> bool | None:
        """Return True if a file exists for this photo, whether valid or not.

        Return None if the photo is never cached.
        """
        origin = source.origin if self._open else None
        return None if origin is None else self._path(origin).is_file()

    def decoded(self, source: Storable) -> Decoded:
        """Return the photo from its entry if the entry is valid.

        If the entry is invalid, decode the photo and store the decoded photo.

        Raises:
            UserError: The photo is damaged.
        """
        origin = source.origin if self._limit else None
        if origin is None:
            return source.decode()
        path = self._path(origin)
        stored = _read(path, *source.target, self._sound.get(path))
        if stored is not None:
            with suppress(OSError):
                self._touch(path, path)
            return stored
        decoded = source.decode()
        if self._open:
            self._keep(path, _packed(decoded))
        return decoded

    def _path(self, origin: str) -> Path:
        return self._folder / f"{sha256(origin.encode()).hexdigest()[:40]}{_KEPT}"

    def _keep(self, path: Path, content: list[bytes | memoryview]) -> None:
        temporary = path.with_name(f"{path.stem}.{os.getpid()}.{next(_NUMBER)}{_TEMPORARY}")
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            size = sum(len(chunk) for chunk in content)
            if not self._has_room(size):
                self._close("its limit is reached, or the disk is full")
                return
            with temporary.open("wb") as file:
                file.writelines(content)
            self._touch(temporary, path)
            temporary.replace(path)
        except OSError as error:
            self._close(error.strerror or str(error))
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)

    def _touch(self, path: Path, entry: Path) -> None:
        now = time_ns()
        os.utime(path, ns=(now, now))
        self._sound[entry] = now

    def _close(self, why: str) -> None:
        """Write no more photos in this run.

        From now on, missing photos are decoded again for each use.
        """
        self._open = False
        _LOG.info("further photos are not stored in %s: %s", self._folder, why)

    def _has_room(self, size: int) -> bool:
        with self._lock:
            if self._used is None or self._used + size > self._limit:
                self._used = self._made_room(size)
            fits = self._used + size <= self._limit
            self._used += size if fits else 0
        return fits and shutil.disk_usage(self._folder).free >= size + RESERVE

    def _made_room(self, size: int) -> int:
        """Delete as many old entries as needed.

        Return the total number of bytes of the remaining entries.
        """
        entries = sorted(_entries(self._folder))
        used = sum(length for _, length, _ in entries)
        for last_used, length, path in entries:
            if used + size <= self._limit or last_used >= self._begun:
                break
            # Another process may already have deleted the file, or may have the file open.
            with suppress(OSError):
                path.unlink()
                used -= length
        return used


def _entries(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Yield the time of last use, the size and the path of each entry.

    Delete files that killed processes left behind.
    """
    with os.scandir(folder) as listing:
        for entry in listing:
            with suppress(OSError):
                facts, path = entry.stat(), Path(entry.path)
                if path.suffix == _KEPT:
                    yield facts.st_mtime, facts.st_size, path
                elif path.suffix == _TEMPORARY and facts.st_mtime < time() - _STALE:
                    path.unlink()


def _packed(decoded: Decoded) -> list[bytes | memoryview]:
    """Return the parts of an entry as bytes.

    The parts are a file signature, a CRC-32 checksum, the pixels, and one bit per pixel for a mask.
    """
    image, mask = decoded
    pixels = image.contiguous().numpy().reshape(-1).data
    bits = b"" if mask is None else np.packbits(mask.numpy()).tobytes()
    check = crc32(bits, crc32(pixels))
    return [_MAGIC, check.to_bytes(_SUM, "little"), pixels, bits]


def _read(path: Path, width: int, height: int, sound: int | None) -> Decoded | None:
    """Read the photo and the mask of an entry. Return None if the entry is missing or invalid.

    If the file time equals `sound` [ns], the checksum is not verified again. The verification takes
    as long as reading.
    """
    head, pixels, bits = len(_MAGIC) + _SUM, 3 * width * height, -(-width * height // 8)
    try:
        with path.open("rb") as file:
            facts = os.fstat(file.fileno())
            size = facts.st_size - head
            if size not in {pixels, pixels + bits}:
                return None
            start, content = file.read(head), np.empty(size, np.uint8)
            if file.readinto(content.data) != size:
                return None
    except OSError:
        return None
    checked = facts.st_mtime_ns == sound
    if not checked and start != _MAGIC + crc32(content.data).to_bytes(_SUM, "little"):
        return None
    image = torch.from_numpy(content[:pixels].reshape(height, width, 3))
    if size == pixels:
        return image, None
    mask = np.unpackbits(content[pixels:], count=width * height).astype(np.bool_)
    return image, torch.from_numpy(mask.reshape(height, width))


@cache
def made_by() -> str:
    """Return everything, except the file itself, that determines the pixels of a decoded photo."""
    names = ("pillow", "pycolmap")
    return f"{PIXELS_VERSION} {' '.join(f'{name} {version(name)}' for name in names)}"
