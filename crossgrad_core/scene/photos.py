"""Photos that are decoded when they are asked for, and the memory that keeps them."""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.decode import Pixels, blend, decode_mask, decode_photo, resize
from crossgrad_core.scene.types import Photo

_OPAQUE, _HALF = 255, 128


@dataclass(frozen=True)
class PhotoSource:
    """How a view's photo comes from its file.

    Attributes:
        path: The photo.
        width: Width of the photo in the pixels that its pose refers to.
        height: Likewise.
        upright: Whether its pose refers to the photo after its EXIF rotation.
        mask: The mask file, or None.
        alpha: Whether the file may have transparent pixels.
        background: RGB in [0, 1] behind transparent pixels; None where they do not count.
        distorted: The calibration to undistort with, in the file's size; None for a pinhole.
        target: (width, height) as trained.
    """

    path: Path
    width: int
    height: int
    upright: bool
    mask: Path | None
    alpha: bool
    background: tuple[float, float, float] | None
    distorted: Calibration | None
    target: tuple[int, int]

    @property
    def may_mask(self) -> bool:
        """Whether some pixels may not count."""
        transparent = self.alpha and self.background is None
        return self.mask is not None or transparent or self.distorted is not None

    def decode(self) -> tuple[Tensor, Tensor | None]:
        """The photo [H, W, 3] uint8 and its mask [H, W] bool, None where every pixel counts.

        Raises:
            UserError: The photo or its mask is damaged or has changed its size.
        """
        rgb, alpha = decode_photo(self.path, self.upright)
        self._check_size(rgb)
        keep = self._decode_mask()
        if alpha is not None and self.background is not None:
            rgb = blend(rgb, alpha, self.background)
        elif alpha is not None:
            opaque = np.where(alpha >= _HALF, _OPAQUE, 0).astype(np.uint8)
            keep = opaque if keep is None else np.minimum(keep, opaque)
        if self.distorted is not None:
            keep = self._undistort_mask(self.distorted, keep)
            rgb = self.distorted.undistort(rgb)
        image = torch.from_numpy(np.ascontiguousarray(resize(rgb, *self.target)))
        if keep is None or keep.min() == _OPAQUE:
            return image, None
        return image, torch.from_numpy(resize(keep, *self.target) >= _HALF)

    def _check_size(self, rgb: Pixels) -> None:
        height, width = rgb.shape[:2]
        if (width, height) != (self.width, self.height):
            raise UserError(
                "the photo has changed since the scene was read",
                where=self.path,
                expected=f"{self.width} x {self.height} pixels",
                found=f"{width} x {height} pixels",
            )

    def _decode_mask(self) -> Pixels | None:
        """The mask file in the photo's size, 0 or 255; the nearest pixel where sizes differ."""
        if self.mask is None:
            return None
        mask = decode_mask(self.mask, upright=False)
        if self.upright and mask.shape == (self.width, self.height) != mask.shape[::-1]:
            mask = decode_mask(self.path, upright=True)
        rows = (np.arange(self.height) * mask.shape[0]) // self.height
        columns = (np.arange(self.width) * mask.shape[1]) // self.width
        return mask[rows][:, columns]

    def _undistort_mask(self, distorted: Calibration, keep: Pixels | None) -> Pixels:
        """The mask in undistorted pixels; pixels that the photo does not reach do not count."""
        reached = distorted.undistort(np.full((self.height, self.width), _OPAQUE, dtype=np.uint8))
        blank = np.where(reached < _OPAQUE, 0, _OPAQUE).astype(np.uint8)
        return blank if keep is None else np.minimum(blank, distorted.undistort(keep))


class PhotoCache:
    """Decoded photos in a bounded amount of memory; may be used from several threads.

    Training walks through all photos again and again. Were the least recently used photo dropped, a
    set a little larger than the memory would hardly ever be found in it, so that what is there
    stays and the *latest* photos make room: of a set twice as large as the memory, half is found.

    Args:
        mib: Memory for decoded photos and masks, MiB. One photo is kept even if it is larger.
    """

    def __init__(self, mib: int) -> None:
        self._limit = mib * 2**20
        self._used = 0
        self._entries: OrderedDict[PhotoSource, tuple[Tensor, Tensor | None]] = OrderedDict()
        self._lock = Lock()

    def get(self, source: PhotoSource) -> tuple[Tensor, Tensor | None]:
        """The decoded photo and mask of `source`; shared, so never to be written to."""
        with self._lock:
            entry = self._entries.get(source)
        if entry is None:
            entry = source.decode()
            with self._lock:
                self._keep(source, entry)
        return entry

    def _keep(self, source: PhotoSource, entry: tuple[Tensor, Tensor | None]) -> None:
        if source in self._entries:
            return
        need = _bytes(entry)
        while self._entries and self._used + need > self._limit:
            self._used -= _bytes(self._entries.popitem(last=True)[1])
        self._entries[source] = entry
        self._used += need


@dataclass(frozen=True, eq=False)
class FilePhoto(Photo):
    """A photo on disk, decoded on demand into the scene's cache."""

    source: PhotoSource
    cache: PhotoCache

    @override
    def image(self) -> Tensor:
        return self.cache.get(self.source)[0]

    @override
    def mask(self) -> Tensor | None:
        return self.cache.get(self.source)[1] if self.source.may_mask else None


def _bytes(entry: tuple[Tensor, Tensor | None]) -> int:
    return sum(tensor.nbytes for tensor in entry if tensor is not None)
