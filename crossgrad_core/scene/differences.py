"""How two fingerprints of a scene differ, in words, and what that means for a trained model."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

from crossgrad_core.scene.fingerprint import DECIMALS, FileMark, Fingerprint
from crossgrad_core.scene.wording import name_some

# Libraries of another machine may round the last digits otherwise.
_TOLERANCE = 10.0 ** (1 - DECIMALS)


class Weight(IntEnum):
    """The weight of a difference for a model that was trained on the former scene."""

    #: Pixels or points are others; every camera and every parameter is where it was.
    CONTENT = 1
    #: Other views are held out.
    HELD_OUT = 2
    #: Other views are trained on, or cameras stand elsewhere: parameters would be misplaced.
    PLACE = 3


@dataclass(frozen=True)
class Difference:
    """One difference.

    Attributes:
        weight: What it means.
        text: What it is.
    """

    weight: Weight
    text: str


def differences(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    """How a scene differs from what it was; empty where it is the same.

    Where other views are trained on, the local frame and all that is measured in it are others as a
    consequence; only the cause is told then.
    """
    found = _views(was, now)
    if not any(each.weight is Weight.PLACE for each in found):
        found += _frame(was, now) or [*_cameras(was, now), *_points(was, now)]
    found += _files(was, now)
    # What a file changed is told in its place, where it is known.
    return found or _others(was, now)


def _views(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    trained, tested = _split(was)
    trains, tests = _split(now)
    found = [
        *_named(Weight.PLACE, "training photos missing", trained - trains - tests),
        *_named(Weight.PLACE, "new training photos", trains - trained - tested),
        *_named(Weight.PLACE, "photos held out that were trained on", trained & tests),
        *_named(Weight.PLACE, "photos trained on that were held out", tested & trains),
        *_named(Weight.HELD_OUT, "held-out photos missing", tested - trains - tests),
        *_named(Weight.HELD_OUT, "new held-out photos", tests - trained - tested),
    ]
    if found and was.lists != now.lists:
        names = {name for name, _ in was.lists.items() ^ now.lists.items()}
        weight = max(each.weight for each in found)
        found.append(Difference(weight, f"{' and '.join(sorted(names))} changed"))
    return found


def _split(of: Fingerprint) -> tuple[set[str], set[str]]:
    trained = {name for name, view in of.views.items() if view.trained}
    return trained, set(of.views) - trained


def _frame(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    before, after = was.frame, now.frame
    shift = max(abs(a - b) for a, b in zip(before.offset, after.offset, strict=True))
    if shift * before.scale < _TOLERANCE and abs(after.scale / before.scale - 1) < _TOLERANCE:
        return []
    text = (
        f"another local frame: its unit is {1 / after.scale:.6g} input units instead of "
        f"{1 / before.scale:.6g}, its origin moved by {shift:.6g}"
    )
    return [Difference(Weight.PLACE, text)]


def _cameras(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    moved = [
        name
        for name in was.views.keys() & now.views.keys()
        if not _close(was.views[name].camera, now.views[name].camera)
    ]
    return _named(Weight.PLACE, "photos of another size, camera or pose", moved)


def _points(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    before, after = was.points, now.points
    if before.count == after.count and _close(before.moments, after.moments):
        return []
    text = f"other SfM points ({after.count:,}; there were {before.count:,})"
    return [Difference(Weight.CONTENT, text)]


def _files(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    common = was.views.keys() & now.views.keys()
    photos = [name for name in common if _differ(was.views[name].photo, now.views[name].photo)]
    masks = [name for name in common if _differ(was.views[name].mask, now.views[name].mask)]
    return [
        *_named(Weight.CONTENT, "photos changed", photos),
        *_named(Weight.CONTENT, "masks changed, new or missing", masks),
    ]


def _others(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    """Differences of the files besides photos and masks; none to a run that did not note them."""
    if was.files is None or now.files is None:
        return []
    names = was.files.keys() | now.files.keys()
    changed = [name for name in names if _differ(was.files.get(name), now.files.get(name))]
    return _named(Weight.CONTENT, "files changed, new or missing", changed)


def _differ(before: FileMark | None, after: FileMark | None) -> bool:
    return before is not after if before is None else before.differs(after)


def _named(weight: Weight, what: str, names: Iterable[str]) -> list[Difference]:
    listed = sorted(names)
    if not listed:
        return []
    return [Difference(weight, f"{what}: {len(listed)} ({name_some(listed)})")]


def _close(before: Sequence[float], after: Sequence[float]) -> bool:
    return len(before) == len(after) and all(
        abs(a - b) <= _TOLERANCE * max(1.0, abs(a)) for a, b in zip(before, after, strict=True)
    )
