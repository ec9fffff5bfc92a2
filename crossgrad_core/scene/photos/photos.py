"""Photos that are decoded on demand, and the memory cache for decoded photos."""

import os
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.scene import Photo
from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.decode import (
    FULL_16_BIT,
    Pixels,
    blend,
    decode_mask,
    decode_photo,
    resize,
    turn,
)
from crossgrad_core.scene.photos.photo_store import Decoded, PhotoStore, Storable, made_by
from crossgrad_core.scene.photos.shapes import is_turned

#: To test a JPEG file, decode the file at an eighth of its width and height. Decoding at an eighth
#: of the size is faster, but still reads all data of the file.
SMALLEST = 8
_OPAQUE, _HALF = 255, 128
#: Seconds that a thread waits for a photo while another thread decodes the photo.
_PATIENCE = 0.5
# Number of recently used photos in the cache. The number exceeds the number of views in a step, so
# that a step decodes each photo only once.
_LATEST = 16
#: Photos with fewer pixels are not cached on disk, because decoding is about as fast as reading
#: from the disk cache.
_LARGE = 2_000_000


@dataclass(frozen=True)
class PhotoSource:
    """All information that is needed to decode a view's photo from its file.

    Attributes:
        path: Path of the photo.
        width: Width of the photo in the orientation that its pose refers to, in pixels.
        height: Height of the photo in the orientation that its pose refers to, in pixels.
        orientation: The EXIF orientation that the pose refers to; 1 if the pose refers to the photo
            as stored.
        mask: Path of the mask; None without a mask.
        alpha: True if the file may contain transparent pixels.
        background: RGB in [0, 1] behind transparent pixels; None if transparent pixels are masked.
        distorted: Calibration of the photo with size `width` x `height` before undistortion; None
            for a pinhole camera.
        target: Width and height of the training photo.
        reduction: Number by which the file's width and height are divided during decoding.
        white: Value of white in a file with 16 bits per channel.
    """

    path: Path
    width: int
    height: int
    orientation: int
    mask: Path | None
    alpha: bool
    background: tuple[float, float, float] | None
    distorted: Calibration | None
    target: tuple[int, int]
    reduction: int = 1
    white: int = FULL_16_BIT

    @property
    def may_mask(self) -> bool:
        """True if some pixels may be masked."""
        transparent = self.alpha and self.background is None
        blank = self.distorted is not None and not self.distorted.fills_frame
        return self.mask is not None or transparent or blank

    @property
    def undistorted_size(self) -> tuple[int, int]:
        """Width and height after undistortion, before resizing."""
        if self.distorted is None:
            return self.width, self.height
        return self.distorted.pinhole.width, self.distorted.pinhole.height

    @property
    def origin(self) -> str | None:
        """Text with everything that determines the pixels.

        The text is None if reading from the cache would save no time.
        """
        pixels = self.width * self.height * self.reduction**2
        if pixels < _LARGE or (self.target == (self.width, self.height) and not self.distorted):
            return None
        files = [self.path] if self.mask is None else [self.path, self.mask]
        try:
            facts = [os.stat(path) for path in files]
        except OSError:  # If a file cannot be read, the decoder raises the error later.
            return None
        marks = [(f.st_size, f.st_mtime_ns, f.st_ctime_ns, f.st_ino) for f in facts]
        return f"{made_by()} {[str(path.absolute()) for path in files]} {marks} {self}"

    @property
    def decoded_bytes(self) -> int:
        """Upper bound on the memory of the decoded photo and its mask, in bytes."""
        return 4 * self.target[0] * self.target[1]

    def decode(self) -> Decoded:
        """Decode the photo [H, W, 3] uint8 and its mask [H, W] bool.

        The mask is None if all pixels are valid.

        Raises:
            UserError: The photo or its mask is damaged, or its size has changed.
        """
        rgb, alpha = decode_photo(self.path, self.reduction, self.white)
        rgb = turn(rgb, self.orientation)
        self._check_size(rgb)
        keep = self._decode_mask()
        if alpha is not None:
            alpha = turn(alpha, self.orientation)
            if self.background is not None:
                rgb = blend(rgb, alpha, self.background)
            else:
                keep = _both(keep, np.where(alpha >= _HALF, _OPAQUE, 0).astype(np.uint8))
        if self.distorted is not None:
            keep = self._undistort_mask(self.distorted, keep)
            rgb = self.distorted.undistort(np.ascontiguousarray(rgb))
        image = torch.from_numpy(np.array(resize(rgb, *self.target), order="C"))
        if keep is None or keep.min() == _OPAQUE:
            return image, None
        return image, torch.from_numpy(resize(keep, *self.target) >= _HALF)

    def try_out(self) -> None:
        """Test whether the photo and its mask can be decoded. A test takes less time than `decode`.

        Raises:
            UserError: The photo or its mask is damaged.
        """
        decode_photo(self.path, SMALLEST)
        if self.mask is not None:
            decode_mask(self.mask)

    def _check_size(self, rgb: Pixels) -> None:
        height, width = rgb.shape[:2]
        if (width, height) != (self.width, self.height):
            raise UserError(
                "the photo has changed since the scene was read",
                where=self.path,
                expected=f"{self.width} x {self.height} pixels",
                found=f"{width} x {height} pixels",
                todo="restore the old photo, or start a new run",
            )

    def _decode_mask(self) -> Pixels | None:
        """Decode the mask in the photo's size, with values 0 and 255.

        If the mask and the photo differ in size, the nearest pixel of the mask is used.
        """
        if self.mask is None:
            return None
        mask = decode_mask(self.mask)
        if is_turned(mask.shape[::-1], (self.width, self.height)):
            mask = turn(mask, self.orientation)
        rows = (np.arange(self.height) * mask.shape[0]) // self.height
        columns = (np.arange(self.width) * mask.shape[1]) // self.width
        return np.asarray(mask[rows[:, None], columns])

    def _undistort_mask(self, distorted: Calibration, keep: Pixels | None) -> Pixels | None:
        """Undistort the mask. Pixels outside the original photo are masked."""
        if keep is not None:
            keep = distorted.undistort(keep)
        if distorted.fills_frame:
            return keep
        return _both(keep, np.where(distorted.reached(), _OPAQUE, 0).astype(np.uint8))


#: Type of the cache keys. Keys must be hashable, and photos with equal keys must have equal pixels.
Key = TypeVar("Key", bound=Storable)


class PhotoCache(Generic[Key]):
    """A cache of decoded photos in limited memory. Several threads may use the cache.

    Training uses all photos again and again, in changing order. If the photos need slightly more
    memory than the limit, a least-recently-used cache would almost never contain the next photo. In
    this cache, old photos stay in memory. A new photo replaces one of the latest few photos, if
    possible a photo that is not expected next. If the photos need twice as much memory as the
    limit, about half of the requests find their photo in memory.

    Args:
        mib: Memory for decoded photos and masks, in MiB. The latest photo is always stored, even if
            the photo exceeds this limit.
        store: Disk cache of the photos; None to use no disk cache.
    """

    def __init__(self, mib: int, store: PhotoStore | None = None) -> None:
        self.limit = mib * 2**20
        self._store = store
        self._used = 0
        self._kept: OrderedDict[Key, Decoded] = OrderedDict()
        self._latest: OrderedDict[Key, Decoded] = OrderedDict()
        self._expected: frozenset[Key] = frozenset()
        self._under_way: dict[Key, Event] = {}
        self._lock = Lock()

    @property
    def used(self) -> int:
        """Bytes of all decoded photos and masks in memory."""
        return self._used

    def expect(self, sources: Iterable[Key]) -> None:
        """Announce the photos that will be requested next.

        The announced photos are removed from memory last.
        """
        self._expected = frozenset(sources)

    def holds(self, source: Key) -> bool:
        """Return True if a photo is in memory or if a thread is decoding it."""
        return source in self._kept or source in self._latest or source in self._under_way

    def get(self, source: Key) -> Decoded:
        """Return the decoded photo and mask of `source`.

        The photo and the mask are shared, so the caller must not change them.

        If another thread is decoding the photo, this call first waits for a short time. If the
        photo is still missing after the wait, this call decodes the photo itself. The wait is
        limited, because the other thread has low priority and may not get a core while other
        programs run.
        """
        over, waited = Event(), False
        while True:
            with self._lock:
                decoded = self._kept.get(source) or self._latest.get(source)
                if decoded is not None:
                    return decoded
                other = self._under_way.setdefault(source, over)
            if other is over or waited:
                break
            waited = not other.wait(_PATIENCE)
        try:
            decoded = self._decoded(source)
            with self._lock:
                self._keep(source, decoded)
            return decoded
        finally:
            if other is over:
                del self._under_way[source]
                over.set()

    def prepare(self, source: Key) -> bool:
        """Write the photo to the disk cache, unless the cache already contains the photo.

        Return False if this photo is never cached on disk.
        """
        there = None if self._store is None else self._store.holds(source)
        if there is False:
            self._decoded(source)
        return there is not None

    def _decoded(self, source: Key) -> Decoded:
        return source.decode() if self._store is None else self._store.decoded(source)

    def _keep(self, source: Key, decoded: Decoded) -> None:
        if source in self._kept or source in self._latest:
            return
        self._latest[source] = decoded
        self._used += _bytes(decoded)
        while self._used > self.limit and len(self._latest) + len(self._kept) > 1:
            self._used -= _bytes(self._dropped())
        if len(self._latest) > _LATEST:
            key, decoded = self._latest.popitem(last=False)
            self._kept[key] = decoded

    def _dropped(self) -> Decoded:
        """Remove a photo that is not expected, the oldest of the latest photos first.

        The newest photo is never removed.
        """
        *others, _ = self._latest
        idle = next((key for key in others if key not in self._expected), None)
        if idle is None and self._kept:
            return self._kept.popitem()[1]
        return self._latest.pop(others[0] if idle is None else idle)


@dataclass(frozen=True, eq=False)
class FilePhoto(Photo):
    """A photo in a file.

    The photo is decoded when it is requested, and the scene's cache stores the decoded photo.
    """

    source: PhotoSource
    cache: PhotoCache[PhotoSource]

    @override
    def image(self) -> Tensor:
        return self.cache.get(self.source)[0]

    @override
    def mask(self) -> Tensor | None:
        return self.cache.get(self.source)[1] if self.source.may_mask else None


def _both(first: Pixels | None, second: Pixels) -> Pixels:
    return second if first is None else np.minimum(first, second)


def _bytes(decoded: Decoded) -> int:
    return sum(tensor.nbytes for tensor in decoded if tensor is not None)
