"""How bright the photos of a scene are beside each other, by SfM tracks."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene, View
from crossgrad_plugins.exposures.tracks.fit import Fit, fitted
from crossgrad_plugins.exposures.tracks.observations import observations_of

#: Usable observations without which tracks tell nothing about a photo.
LEAST = 8
#: Rule by which tracks say that photos differ in exposure: standard deviation of the gains in
#: stops, that deviation over its own standard error, and share of the distance of observations from
#: their points that the gains take away. Measured on scenes with and without (docs/exposure.md).
LEAST_SPREAD, LEAST_RATIO, LEAST_REDUCTION = 0.2, 4.0, 0.15
#: Photos from which on no single one decides: all points of one may lie on what others hide.
_ENOUGH = 5
#: Photos that decide. Of more, runs of consecutive ones do, because these show the same points.
MOST_DECIDING, _CONSECUTIVE = 128, 8

# A run asks more than once, and a scene does not change.
_OF_TRAINING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
_DECIDING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class TrackGains:
    """How bright photos are beside each other where they show the same points.

    Attributes:
        gains: [V] stops above the mean of the photos; 0 where tracks tell nothing.
        counts: [V] usable observations.
        fit: How well the gains explain the observations.
    """

    gains: NDArray[np.float64]
    counts: NDArray[np.int64]
    fit: Fit

    @property
    def known(self) -> NDArray[np.bool_]:
        """[V] about which photos tracks tell something."""
        return self.counts >= LEAST

    @property
    def spread(self) -> float:
        """Standard deviation of the gains, stops."""
        return float(self.gains[self.known].std()) if self.known.any() else 0.0

    @property
    def error(self) -> float:
        """Standard error of the gains, stops, root mean square over the photos."""
        errors = self.fit.errors[self.known]
        return float(np.sqrt(np.square(errors).mean())) if len(errors) else 0.0

    @property
    def differ(self) -> bool:
        """Whether the photos differ in exposure, by the rule."""
        sure = self.spread >= LEAST_RATIO * self.error
        return sure and self._lasting >= LEAST_SPREAD and self.fit.reduction >= LEAST_REDUCTION

    @property
    def _lasting(self) -> float:
        """The spread without the photo farthest from the mean, if there are photos enough."""
        known = self.gains[self.known]
        if len(known) < _ENOUGH:
            return self.spread
        return float(np.delete(known, np.argmax(np.abs(known - known.mean()))).std())

    @property
    def evidence(self) -> str:
        """What the rule goes by, in words."""
        known = self.gains[self.known]
        if not len(known):
            return "no SfM tracks tell how bright the photos are beside each other"
        error = f", standard error {self.error:.2f}" if isfinite(self.error) else ""
        return (
            f"brightness of {len(known)} photos at {int(self.counts.sum()):,} observations of SfM "
            f"points: gains of {self.spread:.2f} stops standard deviation ({known.min():+.2f} to "
            f"{known.max():+.2f}{error}); where points join photos "
            f"of different gains, they take {100.0 * self.fit.reduction:.0f} % off the deviation "
            f"({self.fit.before:.2f} to {self.fit.after:.2f} stops)"
        )


def track_gains(scene: Scene, views: Sequence[View]) -> TrackGains:
    """The gains of the photos of some views."""
    observations = observations_of(scene, views)
    fit = fitted(observations, len(views))
    counts = np.bincount(observations.photos, minlength=len(views))
    known = counts >= LEAST
    gains = np.where(known, fit.gains - fit.gains[known].mean() if known.any() else 0.0, 0.0)
    return TrackGains(gains, counts, fit)


def training_gains(scene: Scene) -> TrackGains:
    """The gains of all training photos, worked out once for a scene."""
    found = _OF_TRAINING.get(scene)
    if found is None:
        found = _OF_TRAINING[scene] = track_gains(scene, scene.train_views)
    return found


def deciding_gains(scene: Scene) -> TrackGains:
    """The gains that decide whether the training photos differ, worked out once for a scene."""
    views = scene.train_views
    if len(views) <= MOST_DECIDING:
        return training_gains(scene)
    found = _DECIDING.get(scene)
    if found is None:
        period = _CONSECUTIVE * len(views) // MOST_DECIDING
        chosen = [view for row, view in enumerate(views) if row % period < _CONSECUTIVE]
        found = _DECIDING[scene] = track_gains(scene, chosen[:MOST_DECIDING])
    return found
