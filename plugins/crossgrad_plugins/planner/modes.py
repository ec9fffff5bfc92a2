"""Whether the distances of the cameras have one mode or two, and how far apart these are."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import ONE_MODE, Scene, bimodality, footprint_of
from crossgrad_plugins.groupings.heights import altitudes, upward
from crossgrad_plugins.groupings.split import log_distances
from crossgrad_plugins.groupings.thresholds import otsu_threshold

#: Two modes that lie closer than this show the scene at much the same size.
LEAST_RATIO: Final = 1.5
#: Views without which Sarle's coefficient of two modes is that of a few points.
FEWEST: Final = 10
#: What is taken for the distance where views show SfM points.
DEPTH: Final = "depth over focal length"
#: The largest logarithm whose exponential is a number.
_MOST: Final = 700.0

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Modes:
    """The distances from which the training views see the scene.

    Attributes:
        quantity: What is taken for the distance.
        logs: [V] its logarithms, of the views that have one.
        height: The deciding bimodality of the cameras' heights; NaN where undefined.
    """

    quantity: str
    logs: _Floats
    height: float

    @cached_property
    def bimodality(self) -> float:
        """Sarle's coefficient, in the form that decides; NaN where undefined."""
        return bimodality(self.logs).deciding

    @cached_property
    def ratio(self) -> float:
        """Far over near: the medians on both sides of the cut in two; 1 where there is one side."""
        far = self.logs > otsu_threshold(self.logs) if len(self.logs) else np.zeros(0, dtype=bool)
        if not far.any():
            return 1.0
        return _exp(np.median(self.logs[far]) - np.median(self.logs[~far]))

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
        return self.enough and self.bimodality >= ONE_MODE and self.ratio >= LEAST_RATIO

    @property
    def enough(self) -> bool:
        """Whether there are views enough to tell two modes from one."""
        return len(self.logs) >= FEWEST

    @property
    def one(self) -> bool:
        """Whether there is one mode."""
        return not self.two and (self.enough or self.spread < LEAST_RATIO)


def modes_of(scene: Scene) -> Modes:
    """The modes of the training views.

    A distance is the median depth of the SfM points that a view shows over its focal length; that
    from the mean camera where fewer than half of the views show points.
    """
    views = scene.train_views
    if not views:
        return Modes(DEPTH, np.zeros(0), float("nan"))
    footprints = np.array([footprint_of(scene, view) for view in views])
    known = np.isfinite(footprints) & (footprints > 0.0)
    axis, _ = upward(scene)
    heights = bimodality(altitudes(scene, views, axis)).deciding
    if 2 * int(known.sum()) >= len(views):
        return Modes(DEPTH, -np.log(footprints[known]), heights)
    logs = log_distances(scene, views).values
    return Modes("distance from the mean camera", logs[np.isfinite(logs)], heights)


def _exp(log: np.floating) -> float:
    return float(np.exp(min(float(log), _MOST)))
