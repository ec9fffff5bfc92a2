"""Octaves of scale, within which losses can be compared."""

from math import log2


def octave(scale: float) -> int:
    """The power of two nearest to a scale: 0 at full size, -1 at half of it.

    Reducing a photo takes detail away, and the loss falls with it. Losses of one octave compare;
    a running loss begins anew where the octave changes.
    """
    return round(log2(scale))
