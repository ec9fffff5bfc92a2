"""Where the exposure of each training photo starts: SfM tracks, else EXIF, else its regime."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene
from crossgrad_plugins.exposures.exif import exposure_values
from crossgrad_plugins.exposures.tracks.gains import training_gains

#: What a start is taken from.
Start: TypeAlias = Literal["auto", "tracks", "exif", "none"]

#: Photos so many stops from the mean share hardly any usable value with the others.
_FAR = 4.0
_NAMED = 3


@dataclass(frozen=True, eq=False)
class Starts:
    """The gains at the start.

    Attributes:
        stops: [P] stops above the mean of the training photos.
        remarks: Where they come from, and what is unusual about them.
    """

    stops: NDArray[np.float64]
    remarks: tuple[str, ...]


def starts_of(scene: Scene, start: Start) -> Starts:
    """The gains of the training photos at the start.

    Args:
        scene: The scene.
        start: `tracks` or `exif` alone, `auto` both, tracks first; `none` starts from 0.

    Raises:
        UserError: A photo cannot be decoded.
    """
    names = [view.name for view in scene.train_views]
    if len(names) == 1:
        return Starts(np.zeros(1), ("exposure: one training photo has no other to differ from",))
    tracks = training_gains(scene) if start in {"auto", "tracks"} else None
    told = exposure_values(scene) if start in {"auto", "exif"} else {}
    of_tracks: dict[str, float] = {}
    if tracks is not None:
        known = zip(names, tracks.gains, tracks.known, strict=True)
        of_tracks = {name: float(gain) for name, gain, is_known in known if is_known}
    of_exif = _beside({name: told[name] for name in names if name in told}, of_tracks)
    found = {**of_exif, **of_tracks}
    rest = [name for name in names if name not in found]
    stops = np.array([found.get(name, np.nan) for name in names])
    stops = _filled(stops, [view.regime for view in scene.train_views])
    stops -= stops.mean()
    remarks = [] if tracks is None else [f"exposure: {tracks.evidence}"]
    remarks += _told_by("EXIF", [name for name in of_exif if name not in of_tracks])
    if start != "none":
        remarks += _told_by("the mean of their regime, for want of usable tracks and EXIF", rest)
    remarks += far_ones(names, stops)
    return Starts(stops, tuple(remarks))


def _beside(told: dict[str, float], of_tracks: dict[str, float]) -> dict[str, float]:
    """EXIF's stops on the scale of the tracks, or around their own mean where there are none."""
    if not told:
        return {}
    both = [of_tracks[name] - value for name, value in told.items() if name in of_tracks]
    shift = median(both) if both else -fmean(told.values())
    return {name: value + shift for name, value in told.items()}


def _filled(stops: NDArray[np.float64], regimes: Sequence[str]) -> NDArray[np.float64]:
    """NaN replaced by the mean of the regime, or of all where no photo of it is known."""
    if np.isnan(stops).all():
        return np.zeros_like(stops)
    filled = stops.copy()
    labels = np.array(regimes)
    for regime in set(regimes):
        own = labels == regime
        known = stops[own & ~np.isnan(stops)]
        mean = float(known.mean() if len(known) else np.nanmean(stops))
        filled[own & np.isnan(stops)] = mean
    return filled


def _told_by(source: str, names: Sequence[str]) -> Iterable[str]:
    if names:
        yield f"exposure: {len(names)} photos start from {source} ({_some(names)})"


def far_ones(names: Sequence[str], stops: Iterable[float]) -> Iterable[str]:
    """What there is to say of photos, each with its stops from the mean."""
    far = [name for name, stop in zip(names, stops, strict=True) if abs(stop) > _FAR]
    if far:
        yield (
            f"exposure: {len(far)} photos are more than {_FAR:g} stops from the mean "
            f"({_some(far)}): little of what they show can be told from black or white; leaving "
            "them out may be better"
        )


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
