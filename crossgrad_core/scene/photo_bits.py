"""The value of white in photos whose files have 16 bits and whose camera may have fewer."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from crossgrad_core.scene.decode import FULL_16_BIT, WHITES, brightest
from crossgrad_core.scene.wording import count

#: Photos of 10, 12 or 14 bits reach this share of that range; darker ones may be anything.
_REACHED: Final = 0.8


def white_of(deep: Sequence[Path]) -> tuple[int, list[str]]:
    """Return the value of white for all grey photos of 16 bits, and a note if it is not the usual.

    All photos share one value, which depends on the brightest pixel of all. Photos that use a small
    part of their range without filling that of a smaller number of bits are left dark.

    Args:
        deep: The photos; all of them are decoded.

    Raises:
        UserError: A photo is damaged.
    """
    with ThreadPoolExecutor() as pool:
        top = max(pool.map(brightest, deep), default=FULL_16_BIT)
    white = next((white for white in WHITES if white >= top), FULL_16_BIT)
    if white == FULL_16_BIT:
        return white, []
    photos = f"photos: {count(len(deep), 'photo')} of 16 bits"
    bits = white.bit_length()
    if white > WHITES[1] and top >= _REACHED * white:
        return white, [f"{photos} hold {bits}-bit values (up to {top}): scaled, {white} is white"]
    return FULL_16_BIT, [
        f"{photos} use {100 * top / FULL_16_BIT:.2g} % of their range (up to {top}) and are dark; if "
        f"they hold {bits}-bit values, save them scaled to 16 bits"
    ]
