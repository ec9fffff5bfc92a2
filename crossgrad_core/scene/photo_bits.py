"""The value of white in photos whose files have 16 bits and whose camera may have fewer."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from crossgrad_core.scene.decode import FULL_16_BIT, WHITES, brightest
from crossgrad_core.scene.wording import count

#: Photos of 8, 10, 12 or 14 bits reach this share of that range; darker ones may be anything.
_REACHED: Final = 0.8
#: Photos with a larger value use their 16 bits.
_DARK: Final = WHITES[-2]
#: Photos that are decoded before the largest value is looked at.
_AT_ONCE: Final = 8


def white_of(deep: Sequence[Path]) -> tuple[int, list[str]]:
    """Return the value of white for all photos of 16 bits, and a note if it is not 65535.

    All photos share one value, which depends on the brightest pixel of all. Photos that use a small
    part of their range without filling that of a smaller number of bits are left dark.

    Args:
        deep: The photos. They are decoded until one is bright enough for 16 bits.

    Raises:
        UserError: A photo is damaged.
    """
    top = 0 if deep else FULL_16_BIT
    with ThreadPoolExecutor() as pool:
        for start in range(0, len(deep), _AT_ONCE):
            top = max(top, *pool.map(brightest, deep[start : start + _AT_ONCE]))
            if top > _DARK:
                break
    if top > _DARK:
        return FULL_16_BIT, []
    white = next(white for white in WHITES if white >= top)
    photos = f"photos: {count(len(deep), 'photo')} of 16 bits"
    bits = white.bit_length()
    if white > WHITES[0] and top >= _REACHED * white:
        return white, [f"{photos} hold {bits}-bit values (up to {top}): scaled, {white} is white"]
    return FULL_16_BIT, [
        f"{photos} use {100 * top / FULL_16_BIT:.2g} % of their range (up to {top}) and are dark; "
        f"if they hold {bits}-bit values, save them scaled to 16 bits"
    ]
