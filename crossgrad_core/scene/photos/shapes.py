"""Compare the sizes of photos and masks, and choose reduced sizes for photos that are too large.

A JPEG file stores each block of 8 x 8 pixels as 8 x 8 frequencies. For a reduced size, the decoder
uses only the lowest 4 x 4, 2 x 2 or 1 x 1 frequencies. With fewer frequencies, the full photo is
never in memory. For progressive JPEG files, a reduced size saves no memory, because the decoder
stores all frequencies.
"""

from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import pillow
from crossgrad_core.scene.photos.headers import PhotoHeader, read_header
from crossgrad_core.scene.wording import megapixels

#: Width and height in pixels.
Size = tuple[int, int]
_REDUCTIONS = (8, 4, 2)


def is_scaled(size: Size, of: Size) -> bool:
    """Return True if one size is the other size times a factor.

    Each side may differ by one pixel.
    """
    least = max((side - 1) / other for side, other in zip(size, of, strict=True))
    most = min((side + 1) / other for side, other in zip(size, of, strict=True))
    return least <= most


def is_turned(size: Size, photo: Size) -> bool | None:
    """Return True if a mask matches its photo only after a quarter turn.

    Return None if the mask does not match in any orientation.
    """
    turned = photo[::-1]
    if size in {photo, turned}:
        return size != photo
    return False if is_scaled(size, photo) else True if is_scaled(size, turned) else None


def check_mask(path: Path, photo: Size, *, may_turn: bool) -> None:
    """Raise an error if a mask is too large, or if its aspect ratio differs from its photo.

    Raises:
        UserError: The mask is too large, its aspect ratio is wrong, or its file is damaged.
    """
    header = read_header(path)
    if header.width * header.height > pillow.MOST_PIXELS:
        raise UserError(
            "the mask is too large to be decoded",
            where=path,
            expected=f"at most {megapixels(pillow.MOST_PIXELS)}",
            found=f"{header.width} x {header.height} pixels",
            todo="save the mask at a smaller size, with the same aspect ratio as its photo",
        )
    turned = is_turned((header.width, header.height), photo)
    if turned is None or (turned and not may_turn):
        raise UserError(
            "the aspect ratio of a mask differs from the aspect ratio of its photo",
            where=path,
            expected=f"{photo[0]} x {photo[1]} pixels, or the same aspect ratio",
            found=f"{header.width} x {header.height} pixels",
            todo="make the mask from the stored photo, at its full size",
        )


def choose_reduction(path: Path, header: PhotoHeader, max_size: int | None) -> int:
    """Choose the number by which both sides of a photo are divided during decoding: 1, 2, 4 or 8.

    The number is 1 for all photos that are small enough to be decoded completely. For larger
    photos, the number is the largest number that leaves at least `max_size` pixels on the longest
    side. If no number leaves at least `max_size` pixels, the smallest possible number is used.

    Raises:
        UserError: The photo is too large. The message suggests a remedy.
    """
    pixels = header.width * header.height
    if pixels <= pillow.MOST_PIXELS:
        return 1
    fits = [r for r in _REDUCTIONS if pixels <= pillow.MOST_PIXELS * r * r]
    if max_size is None or not header.reducible or not fits:
        raise too_large(path, header)
    enough = [r for r in fits if max(header.width, header.height) >= r * max_size]
    return enough[0] if enough else fits[-1]


def too_large(path: Path, header: PhotoHeader) -> UserError:
    """Return the error for a photo that is too large to be decoded completely."""
    way = (
        "--max-size N, such as --max-size 4000, decodes it at a reduced size"
        if header.reducible
        else (
            "put smaller copies of all photos into <images>_2, _4 or _8 next to the "
            "image folder and select their size with --max-size N; or save it as a JPEG "
            "file that is not progressive"
        )
    )
    return UserError(
        "the photo is too large to be decoded",
        where=path,
        expected=f"at most {megapixels(pillow.MOST_PIXELS)}",
        found=f"{header.width} x {header.height} pixels, "
        f"{megapixels(header.width * header.height)}",
        todo=way,
    )
