"""Examines an operator's results on a batch."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_operators.stress.promises import Facts
from crossgrad_operators.stress.reference import Views
from crossgrad_operators.stress.search.batch import Batch, results, search_views
from crossgrad_operators.stress.search.families import USUAL
from crossgrad_operators.stress.search.numba_kernels.measure import measured
from crossgrad_operators.stress.search.quick import exact
from crossgrad_operators.stress.search.subject import Subject
from crossgrad_operators.stress.verdict import UNDETERMINED, to_one_sign

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Power of two by which gradients are scaled to see whether results scale with them.
_SCALE: Final = 2.0**20
#: Relative amount by which gradients are moved to see whether results move with them.
_NUDGE: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Examined:
    """Results of one operator on B cases.

    Attributes:
        batch: The cases.
        finite: [B] whether the results are.
        inside: [B] whether an error is promised.
        known: [B] whether the error is known: there is a reference, and it is proven.
        error: [B] error in units of u kappa; 0 where it is not known, or excused as kappa u > 0.1.
        ratio: [B] |u| over the longest gradient.
        broken: [B] whether a promise is broken.
    """

    batch: Batch
    finite: Flags
    inside: Flags
    known: Flags
    error: Floats
    ratio: Floats
    broken: Flags


def examine(subject: Subject, batch: Batch) -> Examined:
    """Runs an operator on a batch and measures every result."""
    with np.errstate(all="ignore"):
        found = results(subject.operator, batch)
        finite = np.asarray(np.isfinite(found).all(axis=1))
        found = np.where(finite[:, None], found, 0.0)
        facts = facts_of(batch)
        if subject.quick is None:
            error, known = _by_rules(subject, batch, found)
        else:
            facts, error, known = _by_reference(subject, batch, found)
        inside, ratio = subject.promise.inside(facts), _ratio(facts, found)
        known &= finite
        error = np.where(known, error, 0.0)
        wrong = inside & (error > subject.promise.bound(facts))
        far = ~inside & (ratio > subject.promise.factor(batch.views))
        return Examined(batch, finite, inside, known, error, ratio, ~finite | wrong | far)


def facts_of(batch: Batch) -> Facts:
    """What sets are stated in, without the answers."""
    (norms, cosines), nothing = batch.directions, np.zeros(batch.present.shape)
    unknown = np.zeros(len(norms))
    return Facts(norms[..., 0], cosines, batch.present, nothing, unknown, batch.unit)


def _ratio(facts: Facts, found: Floats) -> Floats:
    length, longest = np.linalg.norm(found, axis=1), facts.longest
    return np.where(longest > 0, length / longest, np.where(length > 0, np.inf, 0.0))


def _by_reference(subject: Subject, batch: Batch, found: Floats) -> tuple[Facts, Floats, Flags]:
    """Facts with the answers, errors in units of u kappa, and where these are known."""
    assert subject.quick is not None
    answer = exact(subject.quick, batch, subject.reference.options)
    apart, length, largest = measured(batch.rows, answer.weights, found).T
    facts = replace(facts_of(batch), weights=answer.weights[..., 0], length=length)
    scale = batch.unit * np.maximum(length, largest)
    zero = ~facts.weights.any(axis=1)
    error = np.where(apart > 0, np.where(zero, np.inf, apart / scale), 0.0)
    excused = ~zero & (scale > UNDETERMINED * length)
    return facts, np.where(excused, 0.0, error), answer.proven


def _by_rules(subject: Subject, batch: Batch, found: Floats) -> tuple[Floats, Flags]:
    """Distances from what rules and laws allow, in units of u times the longest vector."""
    if subject.reference.rule is not None:
        apart = np.asarray(np.linalg.norm(to_one_sign(batch.rows, found), axis=1))
    else:
        apart = _lawful(subject, batch, found)
    longest = np.linalg.norm(batch.rows, axis=2).max(axis=1)
    scale = batch.unit * np.maximum(longest, np.linalg.norm(found, axis=1))
    return np.where(apart > 0, apart / scale, 0.0), np.isfinite(apart)


def _lawful(subject: Subject, batch: Batch, found: Floats) -> Floats:
    """[B] how far results are from scaling with the gradients and from following their order."""
    views = search_views(batch.views)
    scaled = results(subject.operator, replace(batch, rows=batch.rows * _SCALE), views) / _SCALE
    apart = np.asarray(np.linalg.norm(scaled - found, axis=1))
    # Near singular Gramians the order may matter; usual gradients are far from them.
    if batch.family == USUAL and batch.views == 2:  # noqa: PLR2004
        turned = Views(views.labels[::-1], views.ratios[::-1], views.seed)
        other = results(subject.operator, replace(batch, rows=batch.rows[:, ::-1]), turned)
        apart = np.maximum(apart, np.linalg.norm(other - found, axis=1))
    return apart


def jumps(subject: Subject, batch: Batch, rng: np.random.Generator) -> Floats:
    """[B] how far results move where the gradients do by 1e-12, over the longest gradient.

    Zero where the method is not continuous. In float64, which has room for so small a change.
    """
    wide = replace(batch, dtype=torch.float64)
    noise = _NUDGE * rng.standard_normal(batch.rows.shape)
    moved = replace(wide, rows=batch.rows * (1 + noise))
    with np.errstate(all="ignore"):
        found, other = results(subject.operator, wide), results(subject.operator, moved)
        jump = _ratio(facts_of(wide), np.asarray(other - found))
        smooth = subject.promise.continuous(facts_of(wide))
        return np.where(smooth & np.isfinite(jump), jump, 0.0)
