"""The modes of the cameras: one or two clusters of distances, and the ratio of their distances."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import ComponentChoice
from crossgrad_core.plugin import Scene, bimodality, footprint_of
from crossgrad_plugins.groupings.heights import altitudes, upward
from crossgrad_plugins.groupings.split import log_distances, otsu_separability, otsu_threshold

#: If the distances of two modes have a smaller ratio, both modes show the scene at nearly equal
#: sizes.
LEAST_RATIO: Final = 1.5
#: Minimum number of views to detect two modes.
FEWEST: Final = 10
#: Minimum share of the views in the smaller mode. A smaller group counts as outliers.
LEAST_SHARE: Final = 0.1
#: Two modes must separate better than all but one of this many samples from a uniform distribution.
ONE_OF: Final = 100
#: Name of the distance that is used if views show SfM points.
DEPTH: Final = "depth over focal length"
FROM_THE_MEAN: Final = "distance from the mean camera"
HEIGHT: Final = "height"
#: Quantity -> the grouping that divides views by this quantity.
_GROUPINGS: Final = {DEPTH: "footprint", FROM_THE_MEAN: "radial", HEIGHT: "altitude"}
#: Number of samples from a uniform distribution, and their maximum size. Even larger samples do not
#: separate better.
_TRIALS, _LARGEST = 1000, 1000
#: Largest number whose exponential is finite.
_MOST: Final = 700.0

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cut:
    """The division of the views into two groups by one quantity, at Otsu's threshold.

    Attributes:
        quantity: Name of the quantity.
        separability: Share of the quantity's variance that is between the two groups.
        usual: Separability of the best of `ONE_OF` samples from a uniform distribution.
        share: Share of the views in the smaller group.
        ratio: Median distance of the far group divided by the median distance of the near group; 1
            if there is only one group.
    """

    quantity: str
    separability: float
    usual: float
    share: float
    ratio: float

    @property
    def two(self) -> bool:
        """True if both groups are modes, and show the scene at different sizes."""
        clean = self.separability > self.usual and self.share >= LEAST_SHARE
        return clean and self.ratio >= LEAST_RATIO

    @property
    def grouping(self) -> ComponentChoice:
        """The grouping that divides the views at this threshold."""
        return ComponentChoice.model_validate({"name": _GROUPINGS[self.quantity], "cut": "otsu"})


@dataclass(frozen=True, eq=False)
class Modes:
    """The distances and heights of the training views.

    Attributes:
        quantity: The kind of distance.
        logs: [V] logarithms of the distances, for the views that have a distance.
        heights: [V] heights of the cameras with a distance, local units.
    """

    quantity: str
    logs: _Floats
    heights: _Floats

    @cached_property
    def bimodality(self) -> float:
        """Sarle's bimodality coefficient of the distances in its robust form; NaN if undefined."""
        return bimodality(self.logs).deciding

    @cached_property
    def cut(self) -> Cut:
        """The division of the views by distance or by height.

        If both quantities give two modes, the one with better separability is used. If none does,
        the distance is used.
        """
        cuts = (self._by(self.quantity, self.logs), self._by(HEIGHT, self.heights))
        modes = [cut for cut in cuts if cut.two]
        return max(modes, key=lambda cut: cut.separability, default=cuts[0])

    @cached_property
    def spread(self) -> float:
        """The 95th percentile of the distances divided by the 5th; 1 without distances."""
        if not len(self.logs):
            return 1.0
        low, high = np.percentile(self.logs, [5.0, 95.0])
        return _exp(high - low)

    @property
    def two(self) -> bool:
        """True if there are two modes, which show the scene at different sizes."""
        return self.enough and self.cut.two

    @property
    def enough(self) -> bool:
        """True if there are enough views to distinguish two modes from one."""
        return len(self.logs) >= FEWEST

    @property
    def one(self) -> bool:
        """True if there is one mode."""
        return not self.two and (self.enough or self.spread < LEAST_RATIO)

    def _by(self, quantity: str, values: _Floats) -> Cut:
        if len(values) < 2:  # noqa: PLR2004 - two sides
            return Cut(quantity, 0.0, 1.0, 0.0, 1.0)
        upper = values > otsu_threshold(values)
        share = min(int(upper.sum()), int((~upper).sum())) / len(values)
        ratio = 1.0
        if share > 0.0:
            ratio = _exp(abs(np.median(self.logs[upper]) - np.median(self.logs[~upper])))
        separability = float(otsu_separability(values))
        return Cut(quantity, separability, _usual(min(len(values), _LARGEST)), share, ratio)


def modes_of(scene: Scene) -> Modes:
    """Return the modes of the training views.

    The distance of a view is the median depth of its SfM points divided by the focal length. If
    fewer than half of the views show points, the distance from the mean camera is used.
    """
    views = scene.train_views
    if not views:
        return Modes(DEPTH, np.zeros(0), np.zeros(0))
    footprints = np.array([footprint_of(scene, view) for view in views])
    measured = np.isfinite(footprints) & (footprints > 0.0)
    axis, _ = upward(scene)
    heights = altitudes(scene, views, axis)
    if 2 * int(measured.sum()) >= len(views):
        return Modes(DEPTH, -np.log(footprints[measured]), heights[measured])
    logs = log_distances(scene, views).values
    there = np.isfinite(logs)
    return Modes(FROM_THE_MEAN, logs[there], heights[there])


@cache
def _usual(views: int) -> float:
    """Return the separability of the best of `ONE_OF` uniform samples of `views` views."""
    samples = np.random.default_rng(0).uniform(size=(_TRIALS, views))
    return float(np.quantile(otsu_separability(samples), 1.0 - 1.0 / ONE_OF))


def _exp(log: np.floating) -> float:
    return float(np.exp(min(float(log), _MOST)))
