"""Photos that are decoded on demand, and the memory cache that holds them."""

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

#: For the test, JPEG files are decoded at an eighth of their width and height. This still reads all
#: data of the file.
SMALLEST = 8
_OPAQUE, _HALF = 255, 128
#: Seconds to wait for a photo that another thread is decoding.
_PATIENCE = 0.5
# Number of photos in the cache. It is larger than the number of views of one step, so that no photo
# is decoded twice in one step.
_LATEST = 16
#: Photos with fewer pixels are decoded about as quickly as they are read from the disk cache.
_LARGE = 2_000_000


@dataclass(frozen=True)
class PhotoSource:
    """How to decode a view's photo from its file.

    Attributes:
        path: The photo.
        width: Width of the photo in the pixels that its pose refers to.
        height: Height of the photo in the pixels that its pose refers to.
        orientation: The EXIF orientation that its pose refers to; 1 for the stored pixel grid.
        mask: The mask file, or None.
        alpha: True if the file may have transparent pixels.
        background: RGB in [0, 1] behind transparent pixels; None if these pixels do not count.
        distorted: Calibration for the undistortion, for the size `width` x `height`; None for a
            pinhole camera.
        target: (width, height) as trained.
        reduction: Divisor of the file's width and height during decoding.
        white: The value of white, if the file has 16 bits per channel.
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
        """True if some pixels may not count."""
        transparent = self.alpha and self.background is None
        blank = self.distorted is not None and not self.distorted.fills_frame
        return self.mask is not None or transparent or blank

    @property
    def undistorted_size(self) -> tuple[int, int]:
        """(width, height) before resizing."""
        if self.distorted is None:
            return self.width, self.height
        return self.distorted.pinhole.width, self.distorted.pinhole.height

    @property
    def origin(self) -> str | None:
        """Everything that determines the pixels; None if decoding is as fast as reading."""
        pixels = self.width * self.height * self.reduction**2
        if pixels < _LARGE or (self.target == (self.width, self.height) and not self.distorted):
            return None
        files = [self.path] if self.mask is None else [self.path, self.mask]
        try:
            facts = [os.stat(path) for path in files]
        except OSError:  # The decoder reports the error later.
            return None
        marks = [(f.st_size, f.st_mtime_ns, f.st_ctime_ns, f.st_ino) for f in facts]
        return f"{made_by()} {[str(path.absolute()) for path in files]} {marks} {self}"

    @property
    def decoded_bytes(self) -> int:
        """Upper bound of the bytes of the decoded photo and a mask."""
        return 4 * self.target[0] * self.target[1]

    def decode(self) -> Decoded:
        """Decode the photo [H, W, 3] uint8 and its mask [H, W] bool; None if all pixels count.

        Raises:
            UserError: The photo or its mask is damaged or has changed its size.
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
        """Test if the files can be decoded, in less time than `decode` needs.

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
        """Decode the mask in the photo's size, 0 or 255; nearest neighbour if the sizes differ."""
        if self.mask is None:
            return None
        mask = decode_mask(self.mask)
        if is_turned(mask.shape[::-1], (self.width, self.height)):
            mask = turn(mask, self.orientation)
        rows = (np.arange(self.height) * mask.shape[0]) // self.height
        columns = (np.arange(self.width) * mask.shape[1]) // self.width
        return np.asarray(mask[rows[:, None], columns])

    def _undistort_mask(self, distorted: Calibration, keep: Pixels | None) -> Pixels | None:
        """Undistort the mask; pixels outside the photo do not count."""
        if keep is not None:
            keep = distorted.undistort(keep)
        if distorted.fills_frame:
            return keep
        return _both(keep, np.where(distorted.reached(), _OPAQUE, 0).astype(np.uint8))


#: Type of the keys. Keys are hashable, and equal keys decode to the same pixels.
Key = TypeVar("Key", bound=Storable)


class PhotoCache(Generic[Key]):
    """A cache of decoded photos in bounded memory; it may be used from several threads.

    Training uses all photos again and again. A least-recently-used cache would almost never contain
    the next photo if the set is slightly larger than the memory. Therefore old photos are kept, and
    new photos replace only the latest few photos that are not expected next. If the set is twice as
    large as the memory, about half of the requests find their photo in memory.

    Args:
        mib: Memory for decoded photos and masks, MiB. The latest photo is always kept.
        store: Disk cache of the photos; None decodes their files.
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
        """Bytes of the decoded photos and masks."""
        return self._used

    def expect(self, sources: Iterable[Key]) -> None:
        """Announce the photos that will be requested next; these photos are dropped last."""
        self._expected = frozenset(sources)

    def holds(self, source: Key) -> bool:
        """Return True if a photo is in memory or is being decoded by some thread."""
        return source in self._kept or source in self._latest or source in self._under_way

    def get(self, source: Key) -> Decoded:
        """Return the decoded photo and mask of `source`; both are shared and must not be changed.

        If another thread is decoding the photo, this call waits only for a short time. The decoding
        thread has low priority and may make no progress while other programs use the cores.
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
        """Write the photo to the disk cache; return False if no photo is written to disk."""
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
        """Remove the oldest photo that is not expected, but never the latest photo."""
        *others, _ = self._latest
        idle = next((key for key in others if key not in self._expected), None)
        if idle is None and self._kept:
            return self._kept.popitem()[1]
        return self._latest.pop(others[0] if idle is None else idle)


@dataclass(frozen=True, eq=False)
class FilePhoto(Photo):
    """A photo on disk, decoded on demand into the scene's cache."""

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
