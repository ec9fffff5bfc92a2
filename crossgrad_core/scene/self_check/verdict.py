"""The verdict on a scene: which photos disagree with the points of the scene, and why."""

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

#: If more than this share of the photos disagrees, the scene as a whole disagrees.
_MOST_BAD: Final = 0.6
#: A photo disagrees if its correlation is below this share of the correlation of the better photos.
_BAD: Final = 0.33
#: A pose is wrong if less than this share of its observed points is in frame.
_IN_FRAME: Final = 0.5
#: A photo is tested as a suspect if its correlation is below this share of the correlation of the
#: better photos. A change or another photo fits a pose if its score is higher by this difference.
_SUSPECT: Final = 0.65
_FITS_BETTER: Final = 0.25
#: Maximum number of photos used for comparison if most photos disagree, and maximum number of
#: tested suspects.
_MOST_COMPARED: Final = 64
_MOST_SUSPECTS: Final = 32
#: A photo fits if it reaches this share of the correlation of the better photos.
_FITS: Final = 0.7
#: If there are at most this many photos, only mirrored and rotated copies are tested, because
#: another change could fit by chance.
_FEW: Final = 2
#: Minimum number of points in frame of a photo that has no tracks or is compared with other photos.
_FEWEST_TESTED: Final = 3 * FEWEST
#: A photo without tracks disagrees if its correlation is this many standard errors below the limit.
_ERRORS: Final = 3.0
#: Number of points that are tested in all photos of a scene without tracks.
_MOST_TESTED: Final = 300_000
#: The better photos are those above this quantile of the correlation.
_BETTER: Final = 0.75
#: Photos with a lower score are also tested with the likely changes of all cameras.
_SURE: Final = 0.75
#: Minimum gain of a small change of all cameras that counts as the cause.
_GAIN_OF_ALL: Final = 0.08


@dataclass(frozen=True)
class Cause:
    """Why some photos disagree.

    Attributes:
        views: The photos.
        what: The cause.
        todo: The remedy for the user.
    """

    views: tuple[int, ...]
    what: str
    todo: str


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of the check for a scene.

    Attributes:
        compared: Number of photos that were compared with points.
        correlation: Median correlation of colours; NaN if nothing could be compared.
        in_frame: Median share of the observed points in frame; NaN without tracks.
        all_wrong: Why the whole scene disagrees; None if it agrees.
        some_wrong: Why some photos disagree.
        notes: Other findings.
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
    """Check some views of a scene.

    Args:
        scene: The scene.
        views: Rows of the views.
        pixels: Decodes the photos of the views.

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
    # If some photos have tracks, skip the photos without tracks, because hidden points would give
    # wrong results.
    if has_tracks.any():
        rows = rows[has_tracks]
        return _Group.of(observed(scene, rows, pixels), rows).verdict()
    return _Group.of(tested(scene, rows, pixels, _MOST_TESTED), rows).verdict()


@dataclass(frozen=True, eq=False)
class _Group:
    """A group of photos, either all with tracks or all without.

    Attributes:
        evidence: The points for the comparison.
        views: [V] rows of the views.
        agreement: Agreement of the unchanged photos.
        recolored: True if the points' own colours are useless; the photos' colours then replace
            them.
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
        """Return the same photos, with the colours of points taken from the other photos."""
        evidence = self.evidence.of_photos()
        return _Group(evidence, self.views, evidence.agreement(evidence.rig), recolored=True)

    @cached_property
    def better(self) -> float:
        """The correlation of the better photos; 0 if no photo has a correlation."""
        correlations = self.agreement.correlation[np.isfinite(self.agreement.correlation)]
        return float(np.quantile(correlations, _BETTER)) if len(correlations) else 0.0

    @property
    def told(self) -> Booleans:
        """[V] photos with enough information for a verdict."""
        return np.isfinite(self.agreement.correlation) | self._out

    @cached_property
    def _out(self) -> Booleans:
        """[V] photos with most of their observed points, or all points, out of frame."""
        if self.evidence.tracked:
            return np.asarray(self.agreement.share < _IN_FRAME)
        out = self.agreement.share == 0.0
        out[out] = self.evidence.sees_nothing(np.flatnonzero(out))
        return np.asarray(out)

    @cached_property
    def bad(self) -> Booleans:
        """[V] photos that disagree: low correlation, and colours that deviate too much."""
        correlation, noise = self.agreement.correlation, self.agreement.noise
        low = np.nan_to_num(correlation, nan=1.0) < _BAD * self.better
        good = np.isfinite(correlation) & ~low
        typical_noise = float(np.median(noise[good])) if good.any() else 0.0
        # The limit is halfway between the noise of consistent photos and of unrelated photos.
        unlike = low & (
            np.nan_to_num(noise) > typical_noise * (1.0 - min(self.better, 0.99) ** 2) ** -0.25
        )
        # Colours that come from only a few other photos are not reliable enough.
        if self.recolored:
            unlike[:] = False
        if not self.evidence.tracked:
            error = 1.0 / np.sqrt(np.maximum(self.agreement.inside, 1))
            unlike &= correlation + _ERRORS * error < _BAD * self.better
        out = self._out & (np.nan_to_num(correlation) < _BAD * self.better)
        return np.asarray(unlike | out)

    def verdict(self) -> Verdict:
        """Return the result for these photos."""
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
        """Find a change of all cameras that improves photos which agree only partly."""
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
        """The mean score of the photos with enough information."""
        return float(scores(self.agreement, tracked=self.evidence.tracked)[self.told].mean())

    def _cause(self, trial: Trial) -> Cause:
        return Cause(tuple(self.views.tolist()), trial.cause, trial.todo)

    def _as_a_whole(self, verdict: Verdict) -> Verdict:
        """Return the result if most photos disagree."""
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
        """Return the result if most photos disagree and no trial repairs them."""
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
        """Return why single photos disagree."""
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
        # If a photo belongs to another pose, its own pose has the wrong photo.
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
        """Find a change that repairs most photos, or a turn that repairs some.

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
        """Return the photos that a change repairs."""
        if diagnosis.trial is None:
            return rows[:0]
        evidence = self.evidence.chosen(rows)
        changed = evidence.agreement(diagnosis.trial.change(evidence.rig))
        return rows[self._fits(scores(changed, tracked=evidence.tracked), rows)]

    def _fits(self, after: Floats, rows: Integers) -> Booleans:
        """Return a mask of the photos that fit only after a change, by their scores."""
        before = scores(self.agreement, tracked=self.evidence.tracked)[rows]
        return np.asarray((after > before + _FITS_BETTER) & (after > self._fitting))

    @property
    def _fitting(self) -> float:
        """The lowest score at which a photo counts as fitting."""
        return max(_FITS * self.better, LEAST)

    def _fitting_others(self, rows: Integers, candidates: Integers) -> Integers:
        """Return the cameras that fit the photo of another camera among the candidates."""
        others = self.views[candidates]
        fitting = []
        for row in rows:
            evidence = self.evidence.chosen(np.full(len(others), row))
            agreement = evidence.agreement(replace(evidence.rig, photos=others))
            fit = scores(agreement, tracked=self.evidence.tracked)
            # With many candidate photos, a photo may fit by chance if it contains few points.
            fit[(others == self.views[row]) | (agreement.inside < _FEWEST_TESTED)] = 0.0
            if self._fits(fit.max(keepdims=True), np.array([row]))[0]:
                fitting.append(row)
        return np.array(fitting, dtype=np.int64)
