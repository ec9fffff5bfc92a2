"""Find the cause of a contradictory scene.

If a trial change makes the scene consistent, this change shows the cause.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Final, TypeAlias

import numpy as np

from crossgrad_core.scene.self_check.evidence import (
    FEWEST,
    Agreement,
    Evidence,
    Floats,
    Integers,
    Rig,
)

#: Largest number of cameras in trials.
MOST_CAMERAS: Final = 12
#: A camera without tracks gets a score of 0 if fewer points than this number are inside its photo.
_FEWEST_UNTRACKED: Final = 3 * FEWEST
#: A later trial replaces an earlier, simpler trial only if its score is higher by more than this
#: number.
_CLEARLY: Final = 0.03
#: A small change counts as an improvement if the score increases by more than this number.
_PROBED: Final = 0.01
#: Number of times that a search halves its step.
_ROUNDS: Final = 4
#: `LEAST`: minimum score of a consistent scene. `GAINED`: minimum gain of a change that repairs a
#: scene.
LEAST: Final = 0.35
GAINED: Final = 0.25
Change: TypeAlias = Callable[[Rig], Rig]
_POSES: Final = "convert the poses of the model to OpenCV axes (x right, y down, z forward)"
_PHOTOS: Final = "restore the photos that the poses were estimated from"
_FLIP: Final = np.diag([1.0, -1.0, -1.0])
_AXES: Final = "xyz"
#: Step of a search for the logarithm of a factor. Step and maximum offset of the principal point,
#: as shares of the photo's width or height.
_FACTOR: Final = 0.04
_OFF: Final = 0.05
_MOST_OFF: Final = 0.5
#: Rotations and reflections of a photo about its centre.
_TURNS: Final = (
    ("the photos are mirrored left to right", [[-1.0, 0.0], [0.0, 1.0]]),
    ("the photos are mirrored top to bottom", [[1.0, 0.0], [0.0, -1.0]]),
    ("the photos are rotated by 180 degrees", [[-1.0, 0.0], [0.0, -1.0]]),
    ("the photos are rotated by 90 degrees", [[0.0, -1.0], [1.0, 0.0]]),
    ("the photos are rotated by 270 degrees", [[0.0, 1.0], [-1.0, 0.0]]),
    ("rows and columns of the photos are exchanged", [[0.0, 1.0], [1.0, 0.0]]),
    ("the photos are rotated by 90 degrees and mirrored", [[0.0, -1.0], [-1.0, 0.0]]),
)


@dataclass(frozen=True)
class Trial:
    """A change of cameras or points that may make a contradictory scene consistent.

    Attributes:
        cause: The defect of the scene, if this change repairs the scene.
        todo: The remedy that is suggested to the user.
        change: Function that applies the change.
    """

    cause: str
    todo: str
    change: Change


@dataclass(frozen=True)
class Diagnosis:
    """The trial with the best score, and the score without any change.

    Attributes:
        before: Score without a change, in [0, 1].
        after: Score after the change, in [0, 1].
        trial: The trial; None if no trial improves the score.
    """

    before: float
    after: float
    trial: Trial | None

    @property
    def repairs(self) -> bool:
        """True if photos and points agree only after the change."""
        return self.after >= LEAST and self.after >= self.before + GAINED


def scores(agreement: Agreement, *, tracked: bool) -> Floats:
    """Return a score [V] in [0, 1] for each camera: the colour correlation.

    With tracks, the correlation is multiplied by the share of points inside the photo.
    """
    correlation = np.maximum(np.nan_to_num(agreement.correlation), 0.0)
    if tracked:
        return np.asarray(correlation * np.nan_to_num(agreement.share))
    return np.where(agreement.inside >= _FEWEST_UNTRACKED, correlation, 0.0)


def some(cameras: Integers, most: int = MOST_CAMERAS) -> Integers:
    """Return at most `most` of the cameras, evenly spaced."""
    every = np.linspace(0, len(cameras) - 1, min(len(cameras), most))
    return cameras[every.round().astype(np.int64)]


@dataclass(frozen=True)
class Search:
    """A change with one or two unknown numbers, for example a factor of the focal length.

    Attributes:
        values: [N, D] the N combinations of D numbers that are tried first.
        step: Distance between neighbouring combinations in `values`.
        trial: Function that makes a trial from D numbers.
    """

    values: Floats
    step: float
    trial: Callable[[Floats], Trial]


class Bench:
    """A test of trials on some cameras of the evidence."""

    def __init__(self, evidence: Evidence, cameras: Integers) -> None:
        self._evidence = evidence.chosen(some(cameras))
        self.before = self.score(self._evidence.rig)

    def score(self, rig: Rig) -> float:
        """Return the mean score of all cameras in a rig."""
        return float(scores(self._evidence.agreement(rig), tracked=self._evidence.tracked).mean())

    def tried(self, trial: Trial) -> float:
        """Return the mean score after the change of a trial."""
        with np.errstate(all="ignore"):
            return self.score(trial.change(self._evidence.rig))

    def is_off(self) -> bool:
        """Return True if some small change of the cameras raises the score."""
        evidence = self._evidence
        first, *others = [probe.change(evidence.rig) for probe in probes()]
        rows = np.tile(evidence.rows, (1 + len(others), 1))
        agreement = replace(evidence, rows=rows).agreement(first.joined(others))
        mean_scores = (
            scores(agreement, tracked=evidence.tracked).reshape(1 + len(others), -1).mean(axis=1)
        )
        return bool(mean_scores.max() > self.before + _PROBED)

    def diagnosis(self) -> Diagnosis:
        """Return the trial with the best score. Common mistakes are tried before rare mistakes."""
        best = self.best(likely())
        if not best.repairs:
            for search in searches():
                best = _better(best, *self._searched(search))
        return best if best.repairs else self.best(other_axes(), best)

    def best(self, trials: Iterable[Trial], found: Diagnosis | None = None) -> Diagnosis:
        """Return the best of several trials, or `found` if no trial is better."""
        found = found or Diagnosis(self.before, self.before, None)
        for trial in trials:
            found = _better(found, self.tried(trial), trial)
        return found

    def _searched(self, search: Search) -> tuple[float, Trial]:
        """Search for the numbers with the best score.

        Try all given values, then refine the best value with halved steps.
        """
        tried = [self.tried(search.trial(value)) for value in search.values]
        best, score, step = search.values[int(np.argmax(tried))], max(tried), search.step
        for _ in range(_ROUNDS):
            step /= 2.0
            around = best + step * np.vstack([np.eye(len(best)), -np.eye(len(best))])
            tried = [self.tried(search.trial(value)) for value in around]
            if max(tried) > score:
                best, score = around[int(np.argmax(tried))], max(tried)
        return score, search.trial(best)


def _better(best: Diagnosis, score: float, trial: Trial) -> Diagnosis:
    return Diagnosis(best.before, score, trial) if score > best.after + _CLEARLY else best


def turns() -> Iterator[Trial]:
    """Yield trials that mirror or rotate the photos."""
    for cause, matrix in _TURNS:
        yield Trial(cause, _PHOTOS, _turned(np.array(matrix)))


def likely() -> Iterator[Trial]:
    """Yield trials that correct common mistakes."""
    yield Trial(
        "the poses have OpenGL axes (y up, z backward)",
        f"{_POSES}: negate the second and third row of each world-to-camera matrix",
        _with_axes(_FLIP),
    )
    yield from _inverted()
    yield from turns()
    yield Trial(
        "the principal point in the model is wrong; the centre of the photos fits better",
        "set the principal point (cx, cy) of the cameras to half of their width and height",
        lambda rig: replace(rig, principal=rig.sizes / 2.0),
    )
    yield Trial(
        "the coordinates of the principal point are swapped",
        "swap cx and cy of the cameras",
        lambda rig: replace(rig, principal=rig.principal[:, ::-1]),
    )
    yield Trial(
        "the focal lengths fx and fy are swapped",
        "swap fx and fy of the cameras",
        lambda rig: replace(rig, focal=rig.focal[:, ::-1]),
    )
    yield from _shifted()


def other_axes() -> Iterator[Trial]:
    """Yield trials with all other orders and signs of the axes, for points and for cameras."""
    for matrix, text in _signed_axes():
        yield Trial(
            f"the points have other axes than the poses: ({text}) of the points fit",
            "export points and poses again from the same program, with the same axes",
            _with_points(matrix),
        )
    for matrix, text in _signed_axes():
        yield Trial(
            f"the cameras have other axes: ({text}) of each camera fit", _POSES, _with_axes(matrix)
        )


def searches() -> Iterator[Search]:
    """Yield searches for unknown numbers.

    The unknown numbers are logarithms of factors, then offsets as shares of width and height.
    """
    for make, most in ((_focal, 5.0), (_scaled, 100.0), (_resized, 10.0)):
        steps = np.arange(-np.log(most), np.log(most), _FACTOR)
        yield Search(steps[:, None], _FACTOR, _by_logarithm(make))
    shares = np.arange(-_MOST_OFF, _MOST_OFF + _OFF, _OFF)
    places = np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    yield Search(places, _OFF, lambda value: _offset(value[0], value[1]))


def probes() -> Iterator[Trial]:
    """Yield small changes of the numeric camera parameters.

    In a correct scene, no small change raises the score.
    """
    for make in (_focal, _scaled):
        yield from (make(value) for value in (0.93, 1.07))
    for value in (-0.04, 0.04):
        yield _offset(value, 0.0)
        yield _offset(0.0, value)


def _by_logarithm(make: Callable[[float], Trial]) -> Callable[[Floats], Trial]:
    return lambda value: make(float(np.exp(value[0])))


def _turned(matrix: Floats) -> Change:
    return lambda rig: replace(rig, turn=matrix)


def _with_axes(matrix: Floats) -> Change:
    return lambda rig: replace(
        rig, rotations=matrix @ rig.rotations, translations=rig.translations @ matrix.T
    )


def _with_points(matrix: Floats) -> Change:
    return lambda rig: replace(rig, points=rig.points @ matrix.T)


def _signed_axes() -> Iterator[tuple[Floats, str]]:
    """Yield all permutations and sign changes of the axes, each with a description.

    The identity is left out.
    """
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            names = (f"{'-' if s < 0 else ''}{_AXES[i]}" for i, s in zip(order, signs, strict=True))
            if not np.array_equal(matrix, np.eye(3)):
                yield matrix, ", ".join(names)


def _inverted() -> Iterator[Trial]:
    """Yield trials that correct poses which are inverted completely or in part."""
    cause = "the poses are camera-to-world, but world-to-camera is expected"
    todo = "invert the 4 x 4 matrix of each pose in the model"
    for camera_axes, text in ((np.eye(3), ""), (_FLIP, ", in OpenGL axes")):
        for world in (np.eye(3), _FLIP):
            yield Trial(f"{cause}{text}", todo, _inverse(camera_axes, world))
    yield Trial(
        "the rotations of the poses are camera-to-world, but world-to-camera is expected",
        "transpose the rotation of each pose in the model",
        lambda rig: replace(rig, rotations=rig.rotations.transpose(0, 2, 1)),
    )
    yield Trial(
        "the rotations of the poses are inverted, but their camera centres are correct",
        "transpose the rotation of each pose in the model and keep the camera centre",
        lambda rig: _placed(rig, rig.rotations.transpose(0, 2, 1), rig.centers),
    )
    yield Trial(
        "the positions of the poses are camera centres, but translations are expected",
        "write the translation -R C of each pose instead of its centre C",
        lambda rig: _placed(rig, rig.rotations, rig.translations),
    )
    yield Trial(
        "the positions of the poses are translations, but camera centres are expected",
        "write the centre C = -R^T t of each pose instead of its translation t",
        lambda rig: replace(rig, translations=rig.centers),
    )
    for order, text in (((3, 0, 1, 2), "(x, y, z, w)"), ((1, 2, 3, 0), "(w, x, y, z)")):
        yield Trial(
            f"the quaternions of the poses have another component order: {text} fits",
            "write the quaternions in the component order of the format",
            _reordered(order),
        )


def _inverse(camera_axes: Floats, world: Floats) -> Change:
    def change(rig: Rig) -> Rig:
        rotations = (camera_axes @ rig.rotations).transpose(0, 2, 1)
        translations = -np.einsum("vij,vj->vi", rotations, rig.translations @ camera_axes.T)
        rig = replace(rig, rotations=rotations, translations=translations)
        return _with_axes(world)(rig)

    return change


def _placed(rig: Rig, rotations: Floats, centers: Floats) -> Rig:
    translations = -np.einsum("vij,vj->vi", rotations, centers)
    return replace(rig, rotations=rotations, translations=translations)


def _reordered(order: tuple[int, ...]) -> Change:
    """Return a change that interprets the quaternions (w, x, y, z) in another component order."""

    def change(rig: Rig) -> Rig:
        from scipy.spatial.transform import Rotation

        quaternions = Rotation.from_matrix(rig.rotations).as_quat()[:, [3, 0, 1, 2]]
        w, x, y, z = quaternions[:, list(order)].T
        rotations = Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()
        return replace(rig, rotations=rotations)

    return change


def _shifted() -> Iterator[Trial]:
    for shift in (1, -1, 2, -2):
        yield Trial(
            f"the photos are shifted by {abs(shift)} relative to the poses: each photo "
            f"fits the pose of the photo {abs(shift)} place{'s' * (abs(shift) > 1)} "
            f"{('before' if shift > 0 else 'after')} it",
            "rename the photos as in the model: one photo may be missing, or the numbers "
            "may start at 1 instead of 0",
            _next(shift),
        )


def _next(shift: int) -> Change:
    return lambda rig: replace(rig, photos=(rig.photos + shift) % rig.count)


def _focal(factor: float) -> Trial:
    return Trial(
        f"the focal length is wrong: {factor:.3g} times its value fits",
        "correct the focal length of the cameras; its unit is pixels of the photos "
        "from which the model was made",
        lambda rig: replace(rig, focal=rig.focal * factor),
    )


def _scaled(factor: float) -> Trial:
    return Trial(
        f"points and camera positions have different units: {factor:.3g} times the points fit",
        "write points and camera positions in the same units",
        # Dividing the translations has the same effect on the image as multiplying the points.
        # Dividing the translations also allows a different factor for each camera.
        lambda rig: replace(rig, translations=rig.translations / factor),
    )


def _resized(factor: float) -> Trial:
    return Trial(
        f"the calibration belongs to photos of another size: {factor:.3g} times its "
        "focal length and principal point fit",
        "correct width, height, focal length and principal point of the cameras",
        lambda rig: replace(rig, focal=rig.focal * factor, principal=rig.principal * factor),
    )


def _offset(across: float, down: float) -> Trial:
    return Trial(
        f"the principal point is wrong: a point moved by {across:+.1%} of the photos' "
        f"width and {down:+.1%} of their height fits",
        "correct the principal point of the cameras; if the photos were cropped, "
        "shift it by the crop",
        lambda rig: replace(rig, principal=rig.principal + rig.sizes * [across, down]),
    )
