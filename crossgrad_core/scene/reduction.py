"""Photos too large to be decoded at once, and at which reduced size a JPEG file is decoded instead.

A JPEG file holds blocks of 8 x 8 frequencies, of which the decoder then takes the lowest 4 x 4, 2 x
2 or 1 x 1: the whole photo never exists. Progressive files keep all frequencies in memory, so they
cannot profit.
"""

from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.scene import pillow
from crossgrad_core.scene.headers import PhotoHeader
from crossgrad_core.scene.wording import megapixels

_REDUCTIONS = (8, 4, 2)


def choose_reduction(path: Path, header: PhotoHeader, max_size: int | None) -> int:
    """By how much each side of a photo is divided while it is decoded: 1, 2, 4 or 8.

    1 for all photos that can be decoded at once; else the most that keeps `max_size` pixels on the
    longest side, or the least that is possible.

    Raises:
        UserError: The photo is too large; says what to do.
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
    """The error for a photo that cannot be decoded at once."""
    way = (
        "--max-size N, such as --max-size 4000, decodes it at a reduced size"
        if header.reducible
        else "put smaller copies of all photos into <images>_2, _4 or _8 beside the image folder "
        "and name their size with --max-size N; or save it as a JPEG file that is not progressive"
    )
    return UserError(
        "the photo is too large to be decoded at once",
        where=path,
        expected=f"at most {megapixels(pillow.MOST_PIXELS)}",
        found=f"{header.width} x {header.height} pixels, "
        f"{megapixels(header.width * header.height)}",
        todo=way,
    )
