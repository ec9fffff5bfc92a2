"""The number of primitives that suits the length of a run."""

from math import exp, log
from typing import Final

from crossgrad_core.plugin import REFERENCE, shortness

#: The budget of runs of so many views, and the power of the length with which the budget of longer
#: runs grows at first: to 100,000 at 10,000 views. Source: measured by metal-gauss.
SHORT_BUDGET, SHORT_LENGTH, POWER = 30_000, 1_000, log(100 / 30) / log(10)
#: A run that begins with few primitives has this many times as many, and this many at least: a
#: short run has no time to place more. Measured by us (docs/schedules.md).
GROWN, LEAST_BUDGET = 2, 10_000
#: Pixels of the photos with which the budget was measured (400 x 300), and the power of larger
#: photos, which show more. Measured by us (docs/schedules.md).
PIXELS, FINER = 120_000, 0.4
#: The additional power in runs with few passes, which cannot overfit, and the pixels of the
#: largest photos (800 x 600) that it was measured with.
FEW_PASSES_FINER, FEW_PASSES_PIXELS = 0.5, 480_000
#: The budget opens towards the published length, which has none, by this factor at most.
OPENED: Final = 10.0


def budget(start: int, length: int, pixels: float = PIXELS, *, few_passes: bool = False) -> int:
    """Return the most primitives of a run; 0 for no bound, as at the published length.

    Args:
        start: Primitives at the start.
        length: Views.
        pixels: Pixels of a training photo, mean.
        few_passes: Whether the run shows each photo only a few times.
    """
    if length >= REFERENCE:
        return 0
    stretch = exp(POWER * log(max(1.0, length / SHORT_LENGTH)))
    enough = min(SHORT_BUDGET, max(LEAST_BUDGET, GROWN * start))
    if enough == SHORT_BUDGET:
        finer = FINER * log(max(1.0, pixels / PIXELS))
        if few_passes:
            finer += FEW_PASSES_FINER * log(max(1.0, min(pixels, FEW_PASSES_PIXELS) / PIXELS))
        stretch *= exp(shortness(length) * finer)
    left = max(1.0 / OPENED, 1.0 - length / REFERENCE)
    return round(max(enough, start) * stretch / left)
