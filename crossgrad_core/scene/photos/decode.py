"""Decode photos and masks to arrays, and resize them."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import pillow
from crossgrad_core.scene.photos.pillow import opened
from crossgrad_core.scene.wording import megapixels

if TYPE_CHECKING:
    from PIL.Image import Image

T = TypeVar("T")
Pixels = NDArray[np.uint8]

RESIZE_FILTER = "scikit-image resize, anti-aliased"

_FULL_8_BIT, FULL_16_BIT = 255, 65535
#: Values of white in files with 1, 8, 10, 12, 14 or 16 bits.
WHITES = (1, _FULL_8_BIT, 1023, 4095, 16383, FULL_16_BIT)
#: Largest share of grey pixels in a black-and-white mask. A pixel is grey if its difference from
#: black and its difference from white exceed a tenth of the range.
_MOST_GREY = 0.05
#: Number of bytes of a photo that are copied at a time. The copied bytes then stay in the
#: processor's cache.
_BAND = 1 << 19
#: SciPy truncates its Gaussian filter at this number of standard deviations.
_WIDTHS = 4.0


def decode_photo(
    path: Path, reduction: int = 1, white: int = FULL_16_BIT
) -> tuple[Pixels, Pixels | None]:
    """Decode a photo to RGB [H, W, 3], and to its alpha channel [H, W] if the photo has one.

    Photos in grey, palette colours, CMYK or 16 bits are converted to 8-bit RGB. The EXIF
    orientation is not applied.

    Args:
        path: Path of the photo.
        reduction: 2, 4 or 8 to decode a JPEG file with both sides divided by this number.
        white: Value of white, for a photo with 16 bits.

    Raises:
        UserError: The photo is damaged, or its kind is not supported.
    """
    if white == FULL_16_BIT:
        return _decode(path, _read_photo, reduction)
    colors, alpha = _decode_deep(path)
    scaled = np.rint(colors * (_FULL_8_BIT / white)).clip(0, _FULL_8_BIT).astype(np.uint8)
    return np.repeat(scaled, 3 // scaled.shape[2], axis=2), alpha


def brightest(path: Path) -> int:
    """Return the largest value in a photo with 16 bits.

    Raises:
        UserError: The photo is damaged, or its kind is not supported.
    """
    return int(_decode_deep(path)[0].max())


def decode_mask(path: Path) -> Pixels:
    """Decode a mask [H, W]: 255 for pixels that are at least half white (valid pixels), else 0.

    White is the largest value of the smallest bit depth that can contain all values of the mask: 1,
    255, 1023, 4095, 16383 or 65535. If the alpha channel varies and the colours are not black and
    white, the alpha channel is the mask.

    Raises:
        UserError: The mask is damaged, or its kind is not supported.
    """
    grey = _decode(path, _read_mask)
    white = next(white for white in WHITES if white >= min(grey.max(), FULL_16_BIT))
    return np.where(grey >= (white + 1) // 2, _FULL_8_BIT, 0).astype(np.uint8)


def resize(image: Pixels, width: int, height: int) -> Pixels:
    """Resize an image [H, W] or [H, W, C].

    The result is bit-identical to scikit-image's anti-aliased resize.
    """
    tall, wide = image.shape[:2]
    if (tall, wide) == (height, width):
        return image
    if height > tall or width > wide:
        return _resized_by_skimage(image, width, height)
    from crossgrad_core.scene.numba_kernels.shrinking import shrink

    small = np.empty((height, width, image[0, 0].size), np.uint8)
    rows = np.ascontiguousarray(image).reshape(tall, -1)
    shrink(rows, _gaussian(tall / height), _gaussian(wide / width), small)
    return small.reshape(height, width, *image.shape[2:])


def _resized_by_skimage(image: Pixels, width: int, height: int) -> Pixels:
    from skimage import transform

    resize_floats: Callable[..., NDArray[np.float32]] = transform.resize
    # Resizing takes half as long in float32 as in float64. The results in float32 and float64
    # differ by less than a hundredth of a grey level.
    floats = resize_floats(image.astype(np.float32), (height, width), anti_aliasing=True)
    return np.asarray(np.rint(floats).clip(0, _FULL_8_BIT), dtype=np.uint8)


def _gaussian(factor: float) -> NDArray[np.float64]:
    """Return the filter weights, from the middle outwards.

    The filter is for a side that is divided by `factor`.
    """
    deviation = (factor - 1.0) / 2.0
    radius = int(_WIDTHS * deviation + 0.5)
    if radius == 0:
        return np.ones(1)
    weights = np.exp(-0.5 / (deviation * deviation) * np.arange(-radius, radius + 1) ** 2)
    return np.asarray((weights / weights.sum())[radius:])


def blend(rgb: Pixels, alpha: Pixels, background: tuple[float, float, float]) -> Pixels:
    """Blend a photo [H, W, 3] with a background colour in [0, 1], by its alpha channel [H, W]."""
    weight = alpha[..., None].astype(np.float32) / _FULL_8_BIT
    behind = np.array(background, dtype=np.float32) * _FULL_8_BIT
    mixed = rgb * weight + behind * (1 - weight)
    return np.asarray(np.rint(mixed), dtype=np.uint8)


def turn(pixels: Pixels, orientation: int) -> Pixels:
    """Rotate pixels [H, W, ...] upright by an EXIF orientation with a quarter turn (5 to 8)."""
    turned = {
        5: pixels.swapaxes(0, 1),
        6: np.rot90(pixels, -1),
        7: pixels[::-1, ::-1].swapaxes(0, 1),
        8: np.rot90(pixels),
    }
    return turned.get(orientation, pixels)


def _decode(path: Path, read: "Callable[[Image], T]", reduction: int = 1) -> T:
    with opened(path, "the photo cannot be decoded") as image:
        if reduction > 1:
            image.draft(None, (image.width // reduction, image.height // reduction))
        if image.width * image.height > pillow.MOST_PIXELS:
            raise UserError(
                "the photo is too large to be decoded",
                where=path,
                expected=f"at most {megapixels(pillow.MOST_PIXELS)}",
                found=f"{image.width} x {image.height} pixels",
                todo="the photo has changed since the scene was read: restore the old photo",
            )
        return read(image)


def _decode_deep(path: Path) -> tuple[NDArray[np.int32], Pixels | None]:
    """Decode a photo with 16 bits to grey [H, W, 1] or RGB [H, W, 3].

    If the photo has an alpha channel, return it with 8 bits.
    """
    upper = _decode(path, np.array)
    if upper.ndim == 2:  # noqa: PLR2004 - grey, which Pillow decodes to 16 bits
        return upper[..., None].astype(np.int32), None
    values = upper[..., :3].astype(np.int32) * 256 + _decode(path, _read_lower)[..., :3]
    return values, upper[..., 3] if upper.shape[2] > 3 else None  # noqa: PLR2004 - alpha


def _read_lower(image: "Image") -> Pixels:
    pillow.take_lower_bytes(image)
    return np.array(image)


def _read_photo(image: "Image") -> tuple[Pixels, Pixels | None]:
    if image.mode.startswith("I"):
        grey = np.rint(_read_grey(image) * (_FULL_8_BIT / FULL_16_BIT)).clip(0, _FULL_8_BIT)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2), None
    if image.mode == "F":
        raise ValueError("the pixels are floating-point numbers; save the photo with 8 or 16 bits")
    if pillow.has_alpha(image):
        rgba = np.array(image.convert("RGBA"))
        return rgba[..., :3].copy(), rgba[..., 3].copy()
    return _colours(image if image.mode == "RGB" else image.convert("RGB")), None


def _colours(image: "Image") -> Pixels:
    """Decode an RGB photo [H, W, 3] in bands of rows.

    For large photos, np.asarray would make three copies.
    """
    pixels = np.empty((image.height, image.width, 3), np.uint8)
    rows = max(1, _BAND // pixels[0].size)
    for top in range(0, image.height, rows):
        band = pixels[top : top + rows]
        values = pillow.rows_of(image, top, top + len(band))
        band[:] = np.frombuffer(values, np.uint8).reshape(band.shape)
    return pixels


def _read_grey(image: "Image") -> NDArray[np.int32]:
    """Read a grey image [H, W] in the value range of its file: up to 255, or up to 65535."""
    wide = image if image.mode.startswith("I") else image.convert("L")
    return np.array(wide).astype(np.int32)


def _read_mask(image: "Image") -> NDArray[np.int32]:
    """Read a mask [H, W] from the grey values of an image.

    If the image has an alpha channel that varies, and its colours are not black and white, alpha is
    used instead.
    """
    if image.mode.startswith("I") or not pillow.has_alpha(image):
        return _read_grey(image)
    grey, alpha = (np.array(band).astype(np.int32) for band in image.convert("LA").split())
    if alpha.min() == alpha.max() or _is_black_and_white(grey):
        return grey
    return alpha


def _is_black_and_white(grey: NDArray[np.int32]) -> bool:
    """Return True if both black and white pixels occur, and hardly any grey pixels."""
    black, white = grey < _FULL_8_BIT // 10, grey > _FULL_8_BIT - _FULL_8_BIT // 10
    neither = 1.0 - float(black.mean() + white.mean())
    return bool(black.any() and white.any() and neither <= _MOST_GREY)
