"""Whether the cameras stand in one mode or in two, and how far apart these are."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import ComponentChoice
from crossgrad_core.plugin import Scene, bimodality, footprint_of
from crossgrad_plugins.groupings.heights import altitudes, upward
from crossgrad_plugins.groupings.split import log_distances, otsu_separability, otsu_threshold

#: Two modes that lie closer than this show the scene at much the same size.
LEAST_RATIO: Final = 1.5
#: Views without which two modes are those of a few points.
FEWEST: Final = 10
#: Share of the views that the smaller mode has: fewer are stragglers.
LEAST_SHARE: Final = 0.1
#: Of so many evenly spread samples, one may be cut as cleanly as two modes are.
ONE_OF: Final = 100
#: What is taken for the distance where views show SfM points.
DEPTH: Final = "depth over focal length"
FROM_THE_MEAN: Final = "distance from the mean camera"
HEIGHT: Final = "height"
#: The grouping that splits by a quantity.
_GROUPINGS: Final = {DEPTH: "footprint", FROM_THE_MEAN: "radial", HEIGHT: "altitude"}
#: Evenly spread samples that are cut, and their largest size: a cut of more separates no more.
_TRIALS, _LARGEST = 1000, 1000
#: The largest logarithm whose exponential is a number.
_MOST: Final = 700.0

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cut:
    """The views cut in two by one number each, where Otsu cuts them.

    Attributes:
        quantity: What the number is.
        separability: Share of its variance that lies between both sides.
        usual: What the cleanest of `ONE_OF` samples that are evenly spread have of that.
        share: Share of the views that the smaller side has.
        ratio: Far over near: the median distances on both sides; 1 where there is one side.
    """

    quantity: str
    separability: float
    usual: float
    share: float
    ratio: float

    @property
    def two(self) -> bool:
        """Whether both sides are modes that show the scene at different sizes."""
        clean = self.separability > self.usual and self.share >= LEAST_SHARE
        return clean and self.ratio >= LEAST_RATIO

    @property
    def grouping(self) -> ComponentChoice:
        """The grouping that splits the views there."""
        return ComponentChoice.model_validate({"name": _GROUPINGS[self.quantity], "cut": "otsu"})


@dataclass(frozen=True, eq=False)
class Modes:
    """The distances from which the training views see the scene, and their heights.

    Attributes:
        quantity: What is taken for the distance.
        logs: [V] its logarithms, of the views that have one.
        heights: [V] heights of the same cameras, local units.
    """

    quantity: str
    logs: _Floats
    heights: _Floats

    @cached_property
    def bimodality(self) -> float:
        """Sarle's coefficient of the distances, in the form that decides; NaN where undefined."""
        return bimodality(self.logs).deciding

    @cached_property
    def cut(self) -> Cut:
        """The views cut in two by distance or by height, where that makes two modes.

        Where both do, the cleaner one; by distance where neither does.
        """
        cuts = (self._by(self.quantity, self.logs), self._by(HEIGHT, self.heights))
        modes = [each for each in cuts if each.two]
        return max(modes, key=lambda each: each.separability, default=cuts[0])

    @cached_property
    def spread(self) -> float:
        """The 95th over the 5th percentile of the distances; 1 without any."""
        if not len(self.logs):
            return 1.0
        low, high = np.percentile(self.logs, [5.0, 95.0])
        return _exp(high - low)

    @property
    def two(self) -> bool:
        """Whether there are two modes that show the scene at different sizes."""
        return self.enough and self.cut.two

    @property
    def enough(self) -> bool:
        """Whether there are views enough to tell two modes from one."""
        return len(self.logs) >= FEWEST

    @property
    def one(self) -> bool:
        """Whether there is one mode."""
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
    """The modes of the training views.

    A distance is the median depth of the SfM points that a view shows over its focal length; that
    from the mean camera where fewer than half of the views show points.
    """
    views = scene.train_views
    if not views:
        return Modes(DEPTH, np.zeros(0), np.zeros(0))
    footprints = np.array([footprint_of(scene, view) for view in views])
    known = np.isfinite(footprints) & (footprints > 0.0)
    axis, _ = upward(scene)
    heights = altitudes(scene, views, axis)
    if 2 * int(known.sum()) >= len(views):
        return Modes(DEPTH, -np.log(footprints[known]), heights[known])
    logs = log_distances(scene, views).values
    there = np.isfinite(logs)
    return Modes(FROM_THE_MEAN, logs[there], heights[there])


@cache
def _usual(views: int) -> float:
    """What a cut separates in the cleanest of `ONE_OF` evenly spread samples of so many views."""
    samples = np.random.default_rng(0).uniform(size=(_TRIALS, views))
    return float(np.quantile(otsu_separability(samples), 1.0 - 1.0 / ONE_OF))


def _exp(log: np.floating) -> float:
    return float(np.exp(min(float(log), _MOST)))
