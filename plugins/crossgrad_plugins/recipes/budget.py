"""The number of primitives that suits the length of a run."""

from math import exp, log
from typing import Final

from crossgrad_core.plugin import REFERENCE, shortness

#: Runs of `SHORT_LENGTH` views have the budget `SHORT_BUDGET`. In longer runs, the budget first
#: grows with this power of the length, for example to 100,000 primitives at 10,000 views. Source:
#: measured by metal-gauss.
SHORT_BUDGET, SHORT_LENGTH, POWER = 30_000, 1_000, log(100 / 30) / log(10)
#: A run that begins with few Gaussians may multiply their number by `GROWN`. It may also always
#: reach `LEAST_BUDGET`. The budget is not larger, because a short run has no time to place more
#: Gaussians (docs/schedules.md).
GROWN, LEAST_BUDGET = 2, 10_000
#: Number of pixels of the photos with which the budget was measured (400 x 300). The budget grows
#: with this power of the number of pixels, because larger photos show more detail. Measured by us
#: (docs/schedules.md).
PIXELS, FINER = 120_000, 0.4
#: Additional power of the number of pixels in runs with few passes, which cannot overfit. It was
#: measured for photos of up to this number of pixels (800 x 600).
FEW_PASSES_FINER, FEW_PASSES_PIXELS = 0.5, 480_000
#: The published length has no budget. For lengths just below it, the budget is multiplied by at
#: most this factor.
OPENED: Final = 10.0


def budget(start: int, length: int, pixels: float = PIXELS, *, few_passes: bool = False) -> int:
    """Return the maximum number of primitives; 0 means no limit, as at the published length.

    Args:
        start: Number of primitives at the start.
        length: Length of the run, in views.
        pixels: Mean number of pixels of a training photo.
        few_passes: True if the run renders each photo only a few times.
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
