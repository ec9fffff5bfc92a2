"""Decide which photos of a scene disagree with its points, and why."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from crossgrad_core.contract.scene import Scene
from crossgrad_core.scene.self_check.diagnosis import (
    LEAST,
    Bench,
    Diagnosis,
    Trial,
    likely,
    scores,
    some,
    turns,
)
from crossgrad_core.scene.self_check.evidence import (
    FEWEST,
    Agreement,
    Booleans,
    Evidence,
    Floats,
    Integers,
    Pixels,
    observed,
    tested,
)

#: If more than this share of the photos disagrees, the scene as a whole is contradictory.
_MOST_BAD: Final = 0.6
#: A photo disagrees if its correlation is below this share of the typical correlation of good
#: photos.
_BAD: Final = 0.33
#: A pose is wrong if less than this share of its observed points is inside the photo.
_IN_FRAME: Final = 0.5
#: `_SUSPECT`: a photo is examined if its correlation is below this share of the typical correlation
#: of good photos. `_FITS_BETTER`: a change, or another photo, fits a pose better if its score is
#: higher by this number.
_SUSPECT: Final = 0.65
_FITS_BETTER: Final = 0.25
#: Maximum number of photos that are compared with other poses if most photos disagree, and maximum
#: number of examined photos.
_MOST_COMPARED: Final = 64
_MOST_SUSPECTS: Final = 32
#: A photo fits if its score reaches this share of the typical correlation of good photos.
_FITS: Final = 0.7
#: Up to this number of photos, only rotations and reflections are tested. Other changes could fit
#: so few photos by chance.
_FEW: Final = 2
#: Minimum number of points inside a photo that has no tracks or is compared with another pose.
_FEWEST_TESTED: Final = 3 * FEWEST
#: A photo without tracks disagrees if its correlation is below the limit by this number of standard
#: errors.
_ERRORS: Final = 3.0
#: Number of points, summed over all photos, that are tested in a scene without tracks.
_MOST_TESTED: Final = 300_000
#: The typical correlation of good photos is this quantile of all correlations.
_BETTER: Final = 0.75
#: If the mean score of the good photos is below this number, changes of all cameras that correct
#: common mistakes are tested.
_SURE: Final = 0.75
#: Smallest gain in score for which a change of all cameras counts as the cause.
_GAIN_OF_ALL: Final = 0.08


@dataclass(frozen=True)
class Cause:
    """The reason why some photos disagree with the points.

    Attributes:
        views: Indices of the photos that disagree.
        what: Description of the cause.
        todo: The remedy that is suggested to the user.
    """

    views: tuple[int, ...]
    what: str
    todo: str


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of checking a scene.

    Attributes:
        compared: Number of photos that were compared with the points.
        correlation: Median colour correlation of all photos; NaN if no colours could be compared.
        in_frame: Median share of the observed points that are inside their photos; NaN without
            tracks.
        all_wrong: Why the scene as a whole is contradictory; None for a consistent scene.
        some_wrong: Why single photos disagree.
        notes: Other results for the user.
    """

    compared: int
    correlation: float
    in_frame: float
    all_wrong: Cause | None = None
    some_wrong: tuple[Cause, ...] = ()
    notes: tuple[str, ...] = ()


_EXCHANGED: Final = (
    "other photos fit their poses better",
    "give each photo the name that its pose has in the model",
)
_STRANGE: Final = (
    "their poses are wrong, or they do not show the points",
    "remove them from the model, or estimate their poses again",
)
_UNRELATED: Final = (
    ("poses, points and photos do not match, and none of the tested corrections repairs them"),
    "check that the model and the photos belong to the same reconstruction",
)
_UNKNOWN: Final = Verdict(0, np.nan, np.nan)


def verdict_of(scene: Scene, views: Sequence[int], pixels: Pixels) -> Verdict:
    """Check some views of a scene, and return the verdict.

    Args:
        scene: The scene.
        views: Indices of the views in the scene.
        pixels: Function that decodes the photo of a view.

    Raises:
        UserError: A photo cannot be decoded.
    """
    if len(scene.points) < FEWEST:
        return replace(
            _UNKNOWN, notes=("the scene has no points that could be compared with the photos",)
        )
    if not views:
        return replace(
            _UNKNOWN, notes=("the scene has no photos that could be compared with the points",)
        )
    has_tracks = np.array([len(scene.views[view].seen) >= FEWEST for view in views])
    rows = np.asarray(views, dtype=np.int64)
    # If some photos have tracks, leave out the photos without tracks. Hidden points in photos
    # without tracks would give wrong results.
    if has_tracks.any():
        rows = rows[has_tracks]
        return _Group.of(observed(scene, rows, pixels), rows).verdict()
    return _Group.of(tested(scene, rows, pixels, _MOST_TESTED), rows).verdict()


@dataclass(frozen=True, eq=False)
class _Group:
    """A group of photos. Either all photos of a group have tracks, or no photo has tracks.

    Attributes:
        evidence: The cameras, points and photos to compare.
        views: [V] indices of the views in the scene.
        agreement: How well the photos agree with the points without any change.
        recolored: True if the colours of the points contain no information. If `recolored` is True,
            colours from other photos replace the colours of the points.
    """

    evidence: Evidence
    views: Integers
    agreement: Agreement
    recolored: bool = False

    @classmethod
    def of(cls, evidence: Evidence, views: Integers) -> "_Group":
        group = cls(evidence, views, evidence.agreement(evidence.rig))
        return group.by_photos() if evidence.tracked and not evidence.colored else group

    def by_photos(self) -> "_Group":
        """Return this group of photos, but with colours of the points from other photos."""
        evidence = self.evidence.of_photos()
        return _Group(evidence, self.views, evidence.agreement(evidence.rig), recolored=True)

    @cached_property
    def better(self) -> float:
        """The typical correlation of good photos; 0 if no photo has a correlation."""
        correlations = self.agreement.correlation[np.isfinite(self.agreement.correlation)]
        return float(np.quantile(correlations, _BETTER)) if len(correlations) else 0.0

    @property
    def told(self) -> Booleans:
        """[V] True for photos with enough information for a verdict."""
        return np.isfinite(self.agreement.correlation) | self._out

    @cached_property
    def _out(self) -> Booleans:
        """[V] True for photos with more than half of their observed points outside the image.

        Without tracks, True if all points of the scene are outside the image.
        """
        if self.evidence.tracked:
            return np.asarray(self.agreement.share < _IN_FRAME)
        out = self.agreement.share == 0.0
        out[out] = self.evidence.sees_nothing(np.flatnonzero(out))
        return np.asarray(out)

    @cached_property
    def bad(self) -> Booleans:
        """[V] True for photos that disagree.

        A photo disagrees if its correlation is low and its colours deviate too much.
        """
        correlation, noise = self.agreement.correlation, self.agreement.noise
        low = np.nan_to_num(correlation, nan=1.0) < _BAD * self.better
        good = np.isfinite(correlation) & ~low
        typical_noise = float(np.median(noise[good])) if good.any() else 0.0
        # The limit is the geometric mean of the noise of good photos and of unrelated photos.
        unlike = low & (
            np.nan_to_num(noise) > typical_noise * (1.0 - min(self.better, 0.99) ** 2) ** -0.25
        )
        # Colours that come from only a few other photos are not reliable enough for this test.
        if self.recolored:
            unlike[:] = False
        if not self.evidence.tracked:
            error = 1.0 / np.sqrt(np.maximum(self.agreement.inside, 1))
            unlike &= correlation + _ERRORS * error < _BAD * self.better
        out = self._out & (np.nan_to_num(correlation) < _BAD * self.better)
        return np.asarray(unlike | out)

    def verdict(self) -> Verdict:
        """Return the verdict on the photos of this group."""
        correlation = self.agreement.correlation
        has_correlation = np.isfinite(correlation)
        verdict = Verdict(
            int(self.told.sum()),
            float(np.median(correlation[has_correlation])) if has_correlation.any() else np.nan,
            float(np.nanmedian(self.agreement.share)) if self.evidence.tracked else np.nan,
            notes=(
                (
                    "the colours of the points contain no information; photos are compared with "
                    "each other"
                ),
            )
            if self.recolored
            else (),
        )
        if not self.told.any():
            if self.evidence.colored and not self.recolored:
                return self._as_a_whole(verdict)
            return replace(verdict, notes=("the colours of points and photos cannot be compared",))
        bad = self.bad
        if self.better < LEAST or bad[self.told].mean() > _MOST_BAD or self._mean < LEAST:
            return self._as_a_whole(verdict)
        cause = self._of_all(np.flatnonzero(self.told & ~bad))
        if cause is not None:
            return replace(verdict, all_wrong=cause)
        return replace(verdict, some_wrong=self.suspects())

    def _of_all(self, rows: Integers) -> Cause | None:
        """Find a change of all cameras that improves photos which agree only in part.

        If no change improves the photos, return None.
        """
        bench = Bench(self.evidence, rows)
        if bench.before < _SURE:
            diagnosis = bench.best(likely())
            if diagnosis.repairs and diagnosis.trial is not None:
                return self._cause(diagnosis.trial)
        if not self.recolored and bench.is_off():
            diagnosis = bench.diagnosis()
            if diagnosis.trial is not None and diagnosis.after >= diagnosis.before + _GAIN_OF_ALL:
                return self._cause(diagnosis.trial)
        return None

    @property
    def _mean(self) -> float:
        """Mean score of the photos with enough information."""
        return float(scores(self.agreement, tracked=self.evidence.tracked)[self.told].mean())

    def _cause(self, trial: Trial) -> Cause:
        return Cause(tuple(self.views.tolist()), trial.cause, trial.todo)

    def _as_a_whole(self, verdict: Verdict) -> Verdict:
        """Return the verdict if most photos disagree."""
        cameras = np.arange(len(self.views))
        bench = Bench(self.evidence, cameras)
        diagnosis = bench.best(likely()) if self.recolored else bench.diagnosis()
        if diagnosis.repairs and diagnosis.trial is not None:
            return replace(verdict, all_wrong=self._cause(diagnosis.trial))
        chosen = some(cameras)
        others = some(cameras, _MOST_COMPARED)
        if not self.recolored and 2 * len(self._fitting_others(chosen, others)) >= len(chosen):
            return replace(verdict, all_wrong=Cause(self._named(cameras), *_EXCHANGED))
        return self._unexplained(verdict)

    def _unexplained(self, verdict: Verdict) -> Verdict:
        """Return the verdict if most photos disagree and no trial makes them agree."""
        if self.better >= LEAST:
            return replace(verdict, some_wrong=self.suspects())
        unrelated = Cause(tuple(self.views.tolist()), *_UNRELATED)
        if self.evidence.tracked and self._out.mean() > _MOST_BAD:
            return replace(verdict, all_wrong=unrelated)
        if self.evidence.tracked and not self.recolored:
            other = self.by_photos()
            if other.better >= LEAST or not np.isfinite(other.agreement.correlation).any():
                return other.verdict()
            return replace(verdict, all_wrong=unrelated)
        note = "the colours of points and photos differ too much for a decision"
        return replace(verdict, notes=(*verdict.notes, note))

    def suspects(self) -> tuple[Cause, ...]:
        """Return the reasons why single photos disagree."""
        bad, correlation = self.bad, self.agreement.correlation
        if self.recolored:
            rows = np.flatnonzero(bad)
            return (Cause(self._named(rows), *_STRANGE),) if len(rows) else ()
        tried = bad | (np.nan_to_num(correlation, nan=1.0) < _SUSPECT * self.better)
        if not self.evidence.tracked:
            tried &= self._out | (self.agreement.inside >= _FEWEST_TESTED)
        rows = np.flatnonzero(tried)[:_MOST_SUSPECTS]
        if not len(rows):
            return ()
        causes = []
        # First test whether photos were exchanged. If a photo belongs to another pose, its own pose
        # has the wrong photo.
        exchanged = self._fitting_others(rows, rows)
        if len(exchanged):
            causes.append(Cause(self._named(exchanged), *_EXCHANGED))
        left = np.setdiff1d(rows, exchanged)
        common, repaired = self._in_common(left)
        if common is not None:
            causes.append(common)
        left = np.setdiff1d(left, repaired)
        if len(left := left[bad[left]]):
            causes.append(Cause(self._named(left), *_STRANGE))
        return tuple(causes)

    def _named(self, rows: Integers) -> tuple[int, ...]:
        return tuple(self.views[rows].tolist())

    def _in_common(self, rows: Integers) -> tuple[Cause | None, Integers]:
        """Find a change that repairs most photos, or a rotation or reflection that repairs some.

        Return the cause, and the rows of the repaired photos.
        """
        none = np.zeros(0, dtype=np.int64)
        if not len(rows):
            return None, none
        bench = Bench(self.evidence, rows)
        if len(rows) > _FEW:
            diagnosis = bench.diagnosis()
            repaired = self._repaired(diagnosis, rows)
            if diagnosis.trial is not None and 2 * len(repaired) > len(rows):
                return Cause(
                    self._named(repaired), diagnosis.trial.cause, diagnosis.trial.todo
                ), repaired
        diagnosis = bench.best(turns())
        repaired = self._repaired(diagnosis, rows)
        if diagnosis.trial is None or not len(repaired):
            return None, none
        return Cause(self._named(repaired), diagnosis.trial.cause, diagnosis.trial.todo), repaired

    def _repaired(self, diagnosis: Diagnosis, rows: Integers) -> Integers:
        """Return the rows of the photos that a trial repairs."""
        if diagnosis.trial is None:
            return rows[:0]
        evidence = self.evidence.chosen(rows)
        changed = evidence.agreement(diagnosis.trial.change(evidence.rig))
        return rows[self._fits(scores(changed, tracked=evidence.tracked), rows)]

    def _fits(self, after: Floats, rows: Integers) -> Booleans:
        """Return a mask of the photos that fit only after a change.

        `after` contains the scores of all photos after the change.
        """
        before = scores(self.agreement, tracked=self.evidence.tracked)[rows]
        return np.asarray((after > before + _FITS_BETTER) & (after > self._fitting))

    @property
    def _fitting(self) -> float:
        """The lowest score with which a photo fits."""
        return max(_FITS * self.better, LEAST)

    def _fitting_others(self, rows: Integers, candidates: Integers) -> Integers:
        """Return the rows of cameras that fit the photo of another camera in `candidates`."""
        others = self.views[candidates]
        fitting = []
        for row in rows:
            evidence = self.evidence.chosen(np.full(len(others), row))
            agreement = evidence.agreement(replace(evidence.rig, photos=others))
            fit = scores(agreement, tracked=self.evidence.tracked)
            # Leave out photos with few projected points. Such a photo could fit by chance, because
            # the camera is compared with many photos.
            fit[(others == self.views[row]) | (agreement.inside < _FEWEST_TESTED)] = 0.0
            if self._fits(fit.max(keepdims=True), np.array([row]))[0]:
                fitting.append(row)
        return np.array(fitting, dtype=np.int64)
