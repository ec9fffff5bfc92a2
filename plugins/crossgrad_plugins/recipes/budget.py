"""The number of primitives that suits the length of a run: its budget."""

from math import exp, log
from typing import Final

from crossgrad_core.plugin import REFERENCE, shortness

#: Runs of `SHORT_LENGTH` views have the budget `SHORT_BUDGET`. In longer runs, the budget grows
#: with the power `POWER` of the length, for example to 100,000 primitives at 10,000 views. Source:
#: measured by metal-gauss.
SHORT_BUDGET, SHORT_LENGTH, POWER = 30_000, 1_000, log(100 / 30) / log(10)
#: The budget of a run with few initial Gaussians is `GROWN` times their number. The budget is
#: always at least `LEAST_BUDGET`. A larger budget does not help, because a short run has no time to
#: place more Gaussians (docs/schedules.md).
GROWN, LEAST_BUDGET = 2, 10_000
#: Number of pixels of the photos with which the budgets were measured (400 x 300). The budget grows
#: with the power `FINER` of the number of pixels, because larger photos show more detail. Both
#: values are measured in docs/schedules.md.
PIXELS, FINER = 120_000, 0.4
#: Additional power of the number of pixels in runs with few passes, because these runs cannot
#: overfit. The power was measured for photos of up to `FEW_PASSES_PIXELS` pixels (800 x 600).
FEW_PASSES_FINER, FEW_PASSES_PIXELS = 0.5, 480_000
#: A run of the published length has no budget. For slightly shorter runs, the budget is multiplied
#: by at most this factor.
OPENED: Final = 10.0


def budget(start: int, length: int, pixels: float = PIXELS, *, few_passes: bool = False) -> int:
    """Return the maximum number of primitives; 0 means no limit, as for the published length.

    Args:
        start: Number of primitives before the first step.
        length: Length of the run, in views.
        pixels: Mean number of pixels of a training photo.
        few_passes: True if the run renders each photo fewer than 40 times.
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
