"""Findings of a report: folders and their joins, photos that are missing or were lost."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import median
from typing import Final

from crossgrad_plugins.prepare.matching import Link
from crossgrad_plugins.prepare.plan import Photo, Plan

#: Fewer features than this find no place among others, and fewer than this share of the usual
#: number, or of the usual sharpness, are worth a word.
_FEW, _LOW_SHARE, _BLURRED_SHARE = 200, 0.25, 0.2
_DARK, _BRIGHT = 30.0, 235.0
#: Heights of a ramp that joins two regimes differ by this factor, at most: SIFT matches photos
#: whose scales differ by less than 1.5 well (docs/prepare.md).
_RUNG: Final = 1.4
_MOST_RUNGS: Final = 12


@dataclass(frozen=True)
class Lost:
    """A photo without a pose.

    Attributes:
        name: Its name.
        features: How many features it has.
        links: With how many photos it has verified matches.
        why: Why it may have none.
    """

    name: str
    features: int
    links: int
    why: str


@dataclass(frozen=True)
class ModelJoin:
    """The matches between two folders, or within one.

    Attributes:
        first: One folder.
        second: The other; the same for pairs within one.
        pairs: Pairs of photos with verified matches.
        matches: These matches together.
    """

    first: str
    second: str
    pairs: int
    matches: int


@dataclass(frozen=True)
class BridgeReport:
    """Photos that are missing between two parts of the scene.

    Attributes:
        first: Folders of the larger part.
        second: Folders of the part that is not joined to it.
        photos: Number of photos of that part.
        pairs: Pairs of photos with verified matches between the parts.
        heights: Metres above ground of the lower and the higher part, where both are known.
        advice: What to do, as a sentence.
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
    """The photos that are not in the scene, and why they may not be.

    Args:
        plan: The plan.
        features: Name -> number of features.
        links: Pairs with verified matches.
        models: Names of the photos of each model, and whether it is in the scene.
        misplaced: Name -> matches for and against the pose of those that were taken out of a model.
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
    usual = median(features.values())
    sharp = median(photo.sharpness for photo in plan.used)
    return tuple(
        Lost(
            photo.name,
            features[photo.name],
            partners[photo.name],
            f"in another model, of {elsewhere[photo.name]} photos"
            if photo.name in elsewhere
            else _contradicted(*misplaced[photo.name])
            if photo.name in misplaced
            else _why(photo, features[photo.name], partners[photo.name], (usual, sharp)),
        )
        for photo in plan.used
        if photo.name not in inside
    )


def _contradicted(agreeing: int, against: int) -> str:
    """Why a photo was taken out of a model."""
    return (
        f"its matches contradict each other: {against} speak against the one place that {agreeing} "
        "speak for (walls, windows or pavements that repeat?)"
    )


def _why(photo: Photo, features: int, partners: int, usual: tuple[float, float]) -> str:
    """Why a photo may have no pose: what is wrong with it, then what it lacks."""
    reasons = []
    if photo.brightness < _DARK:
        reasons.append(f"dark (mean grey level {photo.brightness:.0f} of 255)")
    if photo.brightness > _BRIGHT:
        reasons.append(f"overexposed (mean grey level {photo.brightness:.0f} of 255)")
    if photo.sharpness < _BLURRED_SHARE * usual[1]:
        reasons.append("blurred, or of something without texture")
    if features == 0:
        reasons.append("no feature could be found in it")
    elif features < max(_FEW, _LOW_SHARE * usual[0]):
        reasons.append(f"few features ({features}; usual are {usual[0]:.0f})")
    if features and not partners:
        reasons.append("no verified matches with any other photo")
    elif partners:
        reasons.append(
            f"matches with {partners} photos, but too few of their points are in the model"
        )
    return "; ".join(reasons)


def joins_of(plan: Plan, links: Sequence[Link]) -> tuple[ModelJoin, ...]:
    """By how many matches folders are joined, pairs of folders without any included."""
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
    """Where photos are missing that would join a part of the scene to its largest part.

    Args:
        plan: The plan.
        links: Pairs with verified matches.
        parts: Names of the photos of each model, the largest first, and of folders that are in no
            model at all.
        heights: Name -> metres above ground, where that is known.
    """
    if not parts:
        return ()
    main, grouped = parts[0], dict[str, set[str]]()
    for part in parts[1:]:
        if part - main:
            # One bridge leads to all pieces of a folder.
            grouped.setdefault(_folders(plan, part - main), set()).update(part - main)
    return tuple(_bridge(plan, links, (main, frozenset(p)), heights) for p in grouped.values())


def parts_of(plan: Plan, models: Sequence[frozenset[str]]) -> list[frozenset[str]]:
    """The photos of each model, and of each folder most of whose photos are in no model."""
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
    known = [heights[name] for name in names if name in heights]
    return median(known) if known else None


def _folders(plan: Plan, names: Iterable[str]) -> str:
    """The folders of photos, those with most of them first."""
    inside = set(names)
    counted = Counter(photo.folder for photo in plan.used if photo.name in inside)
    return " + ".join(folder or "photos in no folder" for folder, _ in counted.most_common(3))


def _advice(first: str, second: str, heights: tuple[float, float] | None) -> str:
    """Which photos would join two parts."""
    if first == second:
        return f"{first}: the photos fall apart; add some that overlap with both parts"
    if heights is None:
        return (
            f"photos between {first} and {second} are missing: take a ramp from where one stands "
            f"to where the other does, each photo at most {_RUNG:g} times as far from the scene "
            "as the one before, all looking at the same place"
        )
    low, high = max(1.0, heights[0]), max(1.0, heights[1])
    if high / low <= _RUNG**2:
        return (
            f"{first} and {second} lie at like heights ({low:.0f} and {high:.0f} m) but share no "
            "view: add photos that overlap with both"
        )
    return (
        f"fly a ramp from {low:.0f} to {high:.0f} m here, looking at what both show: photos at "
        f"{', '.join(f'{rung:.0f}' for rung in fallbacks(low, high))} m"
    )


def fallbacks(low: float, high: float) -> list[float]:
    """Heights from the lower to the higher end, each a fixed factor above the one before."""
    steps = min(_MOST_RUNGS, max(1, math.ceil(math.log(high / low) / math.log(_RUNG))))
    return [low * (high / low) ** (step / steps) for step in range(steps + 1)]
