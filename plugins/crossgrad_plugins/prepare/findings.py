"""Findings of a report: matches between folders, photos without a pose, gaps in the scene."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import median
from typing import Final

from crossgrad_plugins.prepare.matching import Link
from crossgrad_plugins.prepare.plan import Photo, Plan

#: A photo is reported if it has fewer features than the first number, fewer than the second value
#: times the median, or less than the third value times the median sharpness.
_FEW, _LOW_SHARE, _BLURRED_SHARE = 200, 0.25, 0.2
_DARK, _BRIGHT = 30.0, 235.0
#: Maximum ratio of the heights of consecutive photos that connect two regimes. SIFT matches photos
#: well if their scales differ by a factor below 1.5 (docs/prepare.md).
_RUNG: Final = 1.4
_MOST_RUNGS: Final = 12


@dataclass(frozen=True)
class Lost:
    """A photo without a pose.

    Attributes:
        name: The photo's name.
        features: Number of features of the photo.
        links: Number of other photos with which the photo has verified matches.
        why: Possible reason for the missing pose.
    """

    name: str
    features: int
    links: int
    why: str


@dataclass(frozen=True)
class ModelJoin:
    """The matches between two folders, or within one folder.

    Attributes:
        first: Name of one folder.
        second: Name of the other folder; for pairs within a folder, the same name.
        pairs: Number of photo pairs with verified matches.
        matches: Number of verified matches in all these pairs.
    """

    first: str
    second: str
    pairs: int
    matches: int


@dataclass(frozen=True)
class BridgeReport:
    """A gap between two parts of the scene, which additional photos can close.

    Attributes:
        first: Folders of the larger part.
        second: Folders of the part that is not connected with the larger part.
        photos: Number of photos of the second part.
        pairs: Number of pairs with verified matches between the two parts.
        heights: Height of the lower and of the higher part above ground, m; None if unknown.
        advice: A sentence that tells the user what to do.
    """

    first: str
    second: str
    photos: int
    pairs: int
    heights: tuple[float, float] | None
    advice: str


def lost_photos(
    plan: Plan,
    features: Mapping[str, int],
    links: Sequence[Link],
    models: Sequence[tuple[frozenset[str], bool]],
    misplaced: Mapping[str, tuple[int, int]],
) -> tuple[Lost, ...]:
    """Return the photos that are not in the scene, with possible reasons.

    Args:
        plan: The plan.
        features: Name -> number of features.
        links: Pairs of photos with verified matches.
        models: Photo names of each model, and True if this model is in the scene.
        misplaced: Name of a photo that was removed from a model -> its matches for and against its
            pose.
    """
    partners: Counter[str] = Counter()
    for link in links:
        partners.update((link.first, link.second))
    inside, elsewhere = set[str](), dict[str, int]()
    for names, is_joined in models:
        if is_joined:
            inside |= names
        else:
            elsewhere |= dict.fromkeys(names, len(names))
    typical = median(features.values())
    sharp = median(photo.sharpness for photo in plan.used)
    return tuple(
        Lost(
            photo.name,
            features[photo.name],
            partners[photo.name],
            f"it belongs to another model, of {elsewhere[photo.name]} photos"
            if photo.name in elsewhere
            else _contradicted(*misplaced[photo.name])
            if photo.name in misplaced
            else _why(photo, features[photo.name], partners[photo.name], (typical, sharp)),
        )
        for photo in plan.used
        if photo.name not in inside
    )


def _contradicted(agreeing: int, against: int) -> str:
    """Return the reason why a photo was removed from a model."""
    return (
        f"its matches contradict each other: {agreeing} support its best position and "
        f"{against} contradict it (repeated walls, windows or pavements?)"
    )


def _why(photo: Photo, features: int, partners: int, typical: tuple[float, float]) -> str:
    """Return why a photo may have no pose: first defects of the photo, then missing matches."""
    reasons = []
    if photo.brightness < _DARK:
        reasons.append(f"dark (mean grey level {photo.brightness:.0f} of 255)")
    if photo.brightness > _BRIGHT:
        reasons.append(f"overexposed (mean grey level {photo.brightness:.0f} of 255)")
    if photo.sharpness < _BLURRED_SHARE * typical[1]:
        reasons.append("blurred, or without texture")
    if features == 0:
        reasons.append("no features were found")
    elif features < max(_FEW, _LOW_SHARE * typical[0]):
        reasons.append(f"few features ({features}; typical: {typical[0]:.0f})")
    if features and not partners:
        reasons.append("no verified matches with any other photo")
    elif partners:
        reasons.append(
            f"matches with {partners} photos, but the model contains too few of their points"
        )
    return "; ".join(reasons)


def joins_of(plan: Plan, links: Sequence[Link]) -> tuple[ModelJoin, ...]:
    """Return the matches for every pair of folders, also for pairs without matches."""
    folder = {photo.name: photo.folder for photo in plan.used}
    pairs: Counter[tuple[str, str]] = Counter()
    matches: Counter[tuple[str, str]] = Counter()
    for link in links:
        first, second = sorted((folder[link.first], folder[link.second]))
        pairs[first, second] += 1
        matches[first, second] += link.matches
    whole = [(name, name) for name in plan.folders] + list(combinations(plan.folders, 2))
    return tuple(ModelJoin(*both, pairs[both], matches[both]) for both in whole)


def bridges_of(
    plan: Plan,
    links: Sequence[Link],
    parts: Sequence[frozenset[str]],
    heights: Mapping[str, float],
) -> tuple[BridgeReport, ...]:
    """Return the gaps between the largest part of the scene and each other part.

    Args:
        plan: The plan.
        links: Pairs of photos with verified matches.
        parts: Photo names of each part, largest part first. A part is a model, or a folder that is
            in no model.
        heights: Name of a photo -> height above ground, m, if known.
    """
    if not parts:
        return ()
    main, grouped = parts[0], dict[str, set[str]]()
    for part in parts[1:]:
        if part - main:
            # Suggest one bridge for all unconnected parts of a folder, because one bridge can
            # connect them all.
            grouped.setdefault(_folders(plan, part - main), set()).update(part - main)
    return tuple(_bridge(plan, links, (main, frozenset(p)), heights) for p in grouped.values())


def parts_of(plan: Plan, models: Sequence[frozenset[str]]) -> list[frozenset[str]]:
    """Return the photos of each model, and of each folder whose photos are mostly missing."""
    posed = frozenset().union(*models)
    missing: dict[str, set[str]] = defaultdict(set)
    sizes: Counter[str] = Counter(photo.folder for photo in plan.used)
    for photo in plan.used:
        if photo.name not in posed:
            missing[photo.folder].add(photo.name)
    whole = [
        frozenset(names) for folder, names in sorted(missing.items())
        if 2 * len(names) > sizes[folder]
    ]  # fmt: skip
    return [*models, *whole]


def _bridge(
    plan: Plan,
    links: Sequence[Link],
    parts: tuple[frozenset[str], frozenset[str]],
    heights: Mapping[str, float],
) -> BridgeReport:
    main, part = parts
    crossing = [
        link for link in links
        if (link.first in main and link.second in part)
        or (link.second in main and link.first in part)
    ]  # fmt: skip
    one, other = _middle(main, heights), _middle(part, heights)
    ends = None if one is None or other is None else (min(one, other), max(one, other))
    first, second = _folders(plan, main), _folders(plan, part)
    advice = _advice(first, second, ends)
    return BridgeReport(first, second, len(part), len(crossing), ends, advice)


def _middle(names: Iterable[str], heights: Mapping[str, float]) -> float | None:
    metres = [heights[name] for name in names if name in heights]
    return median(metres) if metres else None


def _folders(plan: Plan, names: Iterable[str]) -> str:
    """Return folder names as text; folders with most photos come first."""
    inside = set(names)
    counted = Counter(photo.folder for photo in plan.used if photo.name in inside)
    return " + ".join(folder or "photos outside of folders" for folder, _ in counted.most_common(3))


def _advice(first: str, second: str, heights: tuple[float, float] | None) -> str:
    """Return advice about photos that would connect two parts."""
    if first == second:
        return f"{first}: the photos form separate parts; add photos that overlap with both parts"
    if heights is None:
        return (
            f"photos between {first} and {second} are missing: take a series of photos "
            f"from one position to the other, each at most {_RUNG:g} times as far from "
            "the scene as the photo before, all looking at the same place"
        )
    low, high = max(1.0, heights[0]), max(1.0, heights[1])
    if high / low <= _RUNG**2:
        return (
            f"{first} and {second} have similar heights ({low:.0f} and {high:.0f} m) but "
            "no common view: add photos that overlap with both"
        )
    return (
        f"fly from {low:.0f} to {high:.0f} m here, looking at an area that both show: "
        f"photos at {', '.join(f'{rung:.0f}' for rung in fallbacks(low, high))} m"
    )


def fallbacks(low: float, high: float) -> list[float]:
    """Return heights from the lower to the higher end with a constant ratio."""
    steps = min(_MOST_RUNGS, max(1, math.ceil(math.log(high / low) / math.log(_RUNG))))
    return [low * (high / low) ** (step / steps) for step in range(steps + 1)]
