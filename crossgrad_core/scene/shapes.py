"""Sizes of photos and masks: scaled copies of each other, and those of a photo turned upright."""

from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.scene import pillow
from crossgrad_core.scene.headers import read_header
from crossgrad_core.scene.wording import megapixels

#: Width and height in pixels.
Size = tuple[int, int]


def is_scaled(size: Size, of: Size) -> bool:
    """Whether a size is a scaled copy of another one, each side off by at most one pixel."""
    least = max((side - 1) / other for side, other in zip(size, of, strict=True))
    most = min((side + 1) / other for side, other in zip(size, of, strict=True))
    return least <= most


def is_turned(size: Size, photo: Size) -> bool | None:
    """Whether a mask is that of a photo turned by a quarter; None where it fits neither way."""
    turned = photo[::-1]
    if size in {photo, turned}:
        return size != photo
    return False if is_scaled(size, photo) else True if is_scaled(size, turned) else None


def check_mask(path: Path, photo: Size, *, may_turn: bool) -> None:
    """Refuses a mask too large, or not in the proportion of its photo, perhaps of the turned one.

    Raises:
        UserError: See above; or its file is damaged.
    """
    header = read_header(path)
    if header.width * header.height > pillow.MOST_PIXELS:
        raise UserError(
            "the mask is too large to be decoded at once",
            where=path,
            expected=f"at most {megapixels(pillow.MOST_PIXELS)}",
            found=f"{header.width} x {header.height} pixels",
            todo="save it smaller: a mask of any size in the proportion of its photo will do",
        )
    turned = is_turned((header.width, header.height), photo)
    if turned is None or (turned and not may_turn):
        raise UserError(
            "a mask does not have the shape of its photo",
            where=path,
            expected=f"{photo[0]} x {photo[1]} pixels, or in that proportion",
            found=f"{header.width} x {header.height} pixels",
            todo="make the mask from the photo as it is stored, in its own size",
        )
