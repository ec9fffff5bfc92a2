"""Where the exposure of each training photo starts: SfM tracks, EXIF, or other photos."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene, View
from crossgrad_plugins.exposures.exif import exposure_values
from crossgrad_plugins.exposures.neighbours import Neighbours, neighbours_of
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
        messages: Where they come from, and what is unusual about them.
    """

    stops: NDArray[np.float64]
    messages: tuple[str, ...]


def starts_of(scene: Scene, start: Start) -> Starts:
    """The gains of the training photos at the start.

    Args:
        scene: The scene.
        start: `tracks` or `exif` alone, `auto` both, tracks first; `none` starts from 0.
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
    stops, by = _filled(np.array([found.get(name, np.nan) for name in names]), scene.train_views)
    stops -= stops.mean()
    messages = [] if tracks is None else [f"exposure: {tracks.evidence}"]
    messages += _told_by("EXIF", [name for name in of_exif if name not in of_tracks])
    if start != "none":
        messages += _told_by(f"{by}, for want of usable tracks and EXIF", rest)
    messages += outliers(names, stops)
    if scene.test_views and neighbours_of(scene).tell(stops[:, None]):
        near, regime = neighbours_of(scene).errors(stops[:, None])
        messages.append(
            "exposure: held-out photos without EXIF are told from the training photos nearest in "
            f"pose: off by {near:.2f} stops (root mean square) where each training photo is left "
            f"out, the mean of its regime by {regime:.2f}"
        )
    return Starts(stops, tuple(messages))


def _beside(told: dict[str, float], of_tracks: dict[str, float]) -> dict[str, float]:
    """EXIF's stops on the scale of the tracks, or around their own mean where there are none."""
    if not told:
        return {}
    both = [of_tracks[name] - value for name, value in told.items() if name in of_tracks]
    shift = median(both) if both else -fmean(told.values())
    return {name: value + shift for name, value in told.items()}


def _filled(stops: NDArray[np.float64], views: Sequence[View]) -> tuple[NDArray[np.float64], str]:
    """NaN replaced by what neighbours or regimes tell, and by which of them."""
    known = np.flatnonzero(~np.isnan(stops)).tolist()
    of_regime = "the mean of their regime"
    if not len(known):
        return np.zeros_like(stops), of_regime
    filled = stops.copy()
    missing = np.flatnonzero(np.isnan(stops)).tolist()
    neighbours, told = Neighbours([views[row] for row in known]), stops[known]
    if neighbours.tell(told[:, None]):
        for row in missing:
            rows, weights = neighbours.rows_and_weights(views[row].camera)
            filled[row] = weights @ told[rows]
        return filled, "the photos nearest in pose"
    for row in missing:
        own = [each for each in known if views[each].regime == views[row].regime]
        filled[row] = stops[own or known].mean()
    return filled, of_regime


def _told_by(source: str, names: Sequence[str]) -> Iterable[str]:
    if names:
        yield f"exposure: {len(names)} photos start from {source} ({_some(names)})"


def outliers(names: Sequence[str], stops: Iterable[float]) -> Iterable[str]:
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
