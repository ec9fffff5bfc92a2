"""Differences in exposure between the photos of a scene, as table rows and as text."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from statistics import median

from crossgrad_core.plugin import Scene
from crossgrad_plugins.diagnostics.table import Row
from crossgrad_plugins.exposures.exif import exposure_values
from crossgrad_plugins.exposures.tracks.gains import (
    TrackGains,
    deciding_gains,
    track_gains,
)


@dataclass(frozen=True)
class SceneExposure:
    """The exposure of all photos of a scene, by SfM tracks and EXIF headers.

    Attributes:
        rows: A row for each photo, in the order of the scene's views.
        evidence: The values that `--exposure auto` compares; they belong to the gains of the
            training photos.
        differ: True if the photos differ enough for a gain per photo.
        spread: Standard deviation of the gains, stops.
        before: Deviation of the observations before the gains are subtracted, stops.
        after: Deviation of the observations after the gains are subtracted, stops.
    """

    rows: Sequence[Row]
    evidence: str
    differ: bool
    spread: float
    before: float
    after: float

    def lines(self) -> list[str]:
        """Return the lines for a terminal."""
        verdict = (
            ("the photos differ in exposure; a run models this by default (--exposure auto)")
            if self.differ
            else "the exposures need no model (--exposure none)"
        )
        return ["exposure", f"  {self.evidence}", f"  {verdict}"]


def exposure_of(scene: Scene) -> SceneExposure:
    """Return the exposure of all photos, including held-out photos.

    Raises:
        UserError: A photo cannot be decoded.
    """
    rows = _rows(scene, track_gains(scene, scene.views))
    gains = deciding_gains(scene)
    fit = gains.fit
    return SceneExposure(rows, gains.evidence, gains.differ, gains.spread, fit.before, fit.after)


def _rows(scene: Scene, gains: TrackGains) -> list[Row]:
    of_exif = exposure_values(scene)
    photo_gains = zip(scene.views, gains.gains, gains.known, strict=True)
    of_tracks = {view.name: float(gain) for view, gain, is_known in photo_gains if is_known}
    # EXIF data determine exposure only up to a constant. If some photos have EXIF values and track
    # values, the EXIF values are shifted by their mean difference.
    both = [of_tracks[name] - value for name, value in of_exif.items() if name in of_tracks]
    shift = median(both) if both else -sum(of_exif.values()) / max(1, len(of_exif))
    trained = frozenset(scene.train)
    return [
        {
            "photo": view.name,
            "regime": view.regime,
            "part": "train" if index in trained else "test",
            "observations": int(gains.counts[index]),
            "gain_stops": of_tracks.get(view.name, nan),
            "exif_stops": of_exif[view.name] + shift if view.name in of_exif else nan,
        }
        for index, view in enumerate(scene.views)
    ]
