"""The interquartile mean of pairs from several scenes, with a bootstrap stratified by scene.

`scipy.stats.bootstrap` resamples without strata, and its intervals are too narrow for a few pairs:

- Resampling m values of a scene has (m - 1) / m of their variance. Deviations within a scene are
  stretched by sqrt(m / (m - 1)) (Rao and Wu 1988).
- Its quantiles belong to a normal law instead of Student's. The levels are moved accordingly, as in
  Hesterberg's expanded percentile interval (2015), with n - S degrees of freedom for n pairs of S
  scenes.
- Two pairs of a scene have deviations of one size. The deviations of all scenes with two pairs are
  resampled together.
- One bad run moves the mean of its scene, hence all stretched values, but hardly the interquartile
  mean. The estimates are moved back by the effect of stretching alone.

tests/unit/compare/test_harness.py counts false differences with these corrections.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

DRAWS: Final = 2000
_TWO: Final = 2
_SEED: Final = 20_150_101


def iqm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the middle half along the last axis.

    A value on the border of the middle half counts with the share that is inside. Two values give
    their mean; three give the middle value a weight of 2/3. (`scipy.stats.trim_mean` cuts whole
    values.)

    Args:
        values: [..., n] numbers, n >= 1.

    Returns:
        [...] means.
    """
    count = values.shape[-1]
    first = np.arange(count, dtype=np.float64)
    weights = np.minimum(first + 1.0, 0.75 * count) - np.maximum(first, 0.25 * count)
    weights = np.clip(weights, 0.0, None)
    means: NDArray[np.float64] = np.sort(values, axis=-1) @ (weights / weights.sum())
    return means


@dataclass(frozen=True)
class Bootstrap:
    """The estimates of many resampled sets of pairs.

    Attributes:
        draws: [DRAWS] estimates, sorted.
        freedom: Degrees of freedom of the variance within scenes.
    """

    draws: NDArray[np.float64]
    freedom: int

    @classmethod
    def of(cls, values: NDArray[np.float64], scenes: Sequence[str]) -> "Bootstrap":
        """Resample pairs within their scenes; scenes with a single pair are resampled together.

        Args:
            values: [n] differences, n >= 2.
            scenes: The scene of each.
        """
        rng = np.random.default_rng(_SEED)
        strata = _strata(scenes)
        stretched, resampled = np.empty(len(values)), np.empty((DRAWS, len(values)))
        of_two = [each for each in strata if len(each) == _TWO]
        pool = _deviations(values, of_two)
        for stratum in strata:
            own, count = values[stratum], len(stratum)
            stretch = sqrt(count / (count - 1)) if count > 1 else 1.0
            stretched[stratum] = own.mean() + stretch * (own - own.mean())
            source = own.mean() + pool if count == _TWO else stretched[stratum]
            drawn = rng.integers(0, len(source), (DRAWS, count))
            resampled[:, stratum] = source[drawn]
        draws = iqm(resampled) + (iqm(values) - iqm(stretched))
        freedom = max(1, len(values) - len(strata))
        return cls(np.sort(draws), freedom)

    def interval(self, level: float) -> tuple[float, float]:
        """Return the two-sided interval of a level such as 0.95."""
        from scipy.special import ndtr, stdtrit

        tail = float(ndtr(-stdtrit(self.freedom, 0.5 + level / 2.0)))
        low, high = np.quantile(self.draws, [tail, 1.0 - tail])
        return float(low), float(high)

    def cdf(self, border: float) -> float:
        """Return the p-value of an estimate of at most `border`."""
        return self._tail(_share(self.draws, border), float(np.median(self.draws)) - border)

    def sf(self, border: float) -> float:
        """Return the p-value of an estimate of at least `border`."""
        return self._tail(1.0 - _share(self.draws, border), border - float(np.median(self.draws)))

    def _tail(self, share: float, distance: float) -> float:
        """Return the p-value of a share of the draws, given that the intervals are expanded.

        If a border is beyond all draws, its distance from their median in standard deviations
        counts, so that the number of draws limits no p-value.
        """
        from scipy.special import ndtri, stdtr

        least = 0.5 / DRAWS
        place = float(ndtri(min(max(share, least), 1.0 - least)))
        if share < least:
            spread = float(self.draws.std())
            place = min(place, -distance / spread) if spread > 0.0 else -inf
        return float(stdtr(self.freedom, place))


def _deviations(
    values: NDArray[np.float64], strata: Sequence[NDArray[np.intp]]
) -> NDArray[np.float64]:
    """Return the stretched deviations of scenes with two pairs from the means of their scenes."""
    deviations = [sqrt(_TWO) * (values[each] - values[each].mean()) for each in strata]
    return np.concatenate(deviations) if deviations else np.zeros(0)


def _share(draws: NDArray[np.float64], border: float) -> float:
    """Return the share of sorted draws below a border; draws on the border count half."""
    below = int(np.searchsorted(draws, border))
    up_to = int(np.searchsorted(draws, border, side="right"))
    return (below + up_to) / (2 * len(draws))


def _strata(scenes: Sequence[str]) -> list[NDArray[np.intp]]:
    names = np.asarray(scenes)
    strata = [np.flatnonzero(names == name) for name in dict.fromkeys(scenes)]
    single = [each for each in strata if len(each) == 1]
    several = [each for each in strata if len(each) > 1]
    return [*several, np.concatenate(single)] if single else several
