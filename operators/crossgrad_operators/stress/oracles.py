"""Reference implementations (oracles) of all operators with 50 digits, written from their formulas.

An oracle receives the exact Gramian of the views that have a gradient, and returns the weights of
these views. Oracles include two thresholds that crossgrad defines: the limit 1 + cos = 1e-12 for
opposite directions, and the eigenvalue limit of Aligned-MTL.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crossgrad_operators.stress.exact import (
    Matrix,
    Number,
    Vector,
    dot,
    form,
    number,
    require_mpmath,
)

#: Two directions count as exactly opposite if 1 + cos is at most this value.
OPPOSITE = "1e-12"
#: Two directions count as orthogonal if |cos| is at most this value. The rounding error of a cosine
#: has about this size.
UNRELATED = "1e-14"


@dataclass(frozen=True, eq=False)
class Question:
    """The input of an oracle.

    Attributes:
        gramian: [n][n] exact Gramian of the n views that have a gradient.
        places: [n] indices of these views among all K views.
        views: Number of views K.
        options: Options of the operator.
        labels: [n] labels of the groups of the views.
        ratios: [n] camera distances, divided by the reference distance.
        rng: A random generator that draws the numbers that the operator's generator draws.
        memory: Values that the oracle stored in earlier steps. The oracle may change this
            dictionary.
    """

    gramian: Matrix
    places: Sequence[int]
    views: int
    options: Mapping[str, Any]
    labels: Sequence[str]
    ratios: Sequence[float]
    rng: np.random.Generator
    memory: dict[Any, Any] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number n of views that have a gradient."""
        return len(self.places)


#: Function that returns the weights [n] of the views that have a gradient.
Oracle = Callable[[Question], Vector]


def lengths(gramian: Matrix) -> Vector:
    """Return the norms [n] of the gradients."""
    mp = require_mpmath().mp
    return [mp.sqrt(gramian[k][k]) for k in range(len(gramian))]


def cosines(gramian: Matrix) -> Matrix:
    """Return the cosines [n][n] of the gradients."""
    n = lengths(gramian)
    size = range(len(n))
    return [[gramian[i][j] / n[i] / n[j] for j in size] for i in size]


def is_noise(cosine: Matrix, x: Sequence[Number]) -> bool:
    """Return True if sum x_k e_k is only rounding noise of exactly opposite unit gradients e_k."""
    return cancels(form(cosine, x), max(abs(v) for v in x))


def cancels(square: Number, largest: Number) -> bool:
    """Return True if a sum counts as zero.

    `square` is the squared length of the sum, and `largest` is the length of the longest summand.
    """
    return bool(square <= 2 * number(OPPOSITE) * largest**2)


def zeros(count: int) -> Vector:
    """Return n weights of zero."""
    return [number(0)] * count


def sum_of(question: Question) -> Vector:
    """Return a weight of 1 for each view."""
    return [number(1)] * question.count


def mean_of(question: Question) -> Vector:
    """Return a weight of 1 / K for each view, where K also counts views without a gradient."""
    return [number(1) / question.views] * question.count


def preconditioned(question: Question) -> Vector:
    """Return (r / r_ref)^d with the exponent d of geometry. The ratio is limited to [1e-2, 1e2]."""
    power = number(question.options["geometry"])
    limited = (min(max(number(r), number("0.01")), number(100)) for r in question.ratios)
    return [r**power for r in limited]


def projected_rows(
    question: Question,
    gate: Callable[[int, int], bool] = lambda _i, _j: True,
    *,
    threshold: Number = 0,
    strength: Number = 1,
    shuffled: bool = False,
) -> Matrix:
    """Return the rows v_i [n][n] after pairwise projection."""
    return [
        _projected_row(question, i, partners, gate, (threshold, strength))
        for i, partners in enumerate(partners_of(question, shuffled=shuffled))
    ]


def partners_of(question: Question, *, shuffled: bool) -> list[list[int]]:
    """Return the partners of each view that has a gradient.

    The partners are the other views with a gradient, in the order of projection.
    """
    order = np.tile(np.arange(question.views), (question.views, 1))
    if shuffled and question.views > 2:  # noqa: PLR2004
        order = question.rng.permuted(order, axis=1)
    position_of = {view: i for i, view in enumerate(question.places)}
    return [
        [position_of[j] for j in order[view].tolist() if j in position_of and j != view]
        for view in question.places
    ]


class _Combination:
    """A sum of terms v_k g_k to which terms can be added, and its dot products with all gradients.

    Args:
        gramian: [n][n] Gramian.
        norms: [n] norms of the gradients.
        i: Index of the gradient with which the sum starts.
    """

    def __init__(self, gramian: Matrix, norms: Vector, i: int) -> None:
        self._gramian = gramian
        self._norms = norms
        self.v = zeros(len(gramian))
        self.products = zeros(len(gramian))
        self.add(i, number(1))

    def add(self, j: int, x: Number) -> None:
        """Add x times the gradient g_j."""
        self.v[j] += x
        self.products = [p + x * g for p, g in zip(self.products, self._gramian[j], strict=True)]

    @property
    def length(self) -> Number:
        """The length of the sum.

        A length below 1.4e-6 times the longest summand is returned as exactly zero.
        """
        square = dot(self.v, self.products)
        longest = max(abs(x) * n for x, n in zip(self.v, self._norms, strict=True))
        return number(0) if cancels(square, longest) else require_mpmath().mp.sqrt(square)


def _projected_row(
    question: Question,
    i: int,
    partners: Sequence[int],
    gate: Callable[[int, int], bool],
    rule: tuple[Number, Number],
) -> Vector:
    threshold, strength = rule
    # At a threshold above 0, the rule is not continuous. A cosine exactly at the threshold is
    # therefore not a conflict.
    least = threshold + (number(OPPOSITE) if threshold else 0)
    norms = lengths(question.gramian)
    row = _Combination(question.gramian, norms, i)
    length = row.length
    for j in partners:
        cosine = row.products[j] / length / norms[j]
        if not gate(i, j) or not (cosine < 0 and cosine < -least):
            continue
        if strength == 1 and 1 + cosine <= number(OPPOSITE):
            return zeros(question.count)
        row.add(j, -strength * row.products[j] / norms[j] ** 2)
        length = row.length
        if not length:
            return zeros(question.count)
    return row.v


def column_sums(rows: Matrix) -> Vector:
    """Return the weights for a matrix whose rows are added."""
    return [sum(row[k] for row in rows) for k in range(len(rows[0]))] if rows else []


def pcgrad(question: Question) -> Vector:
    """Return the weights of PCGrad with the random order of the operator."""
    return column_sums(projected_rows(question, shuffled=True))


def symmetric(question: Question) -> Vector:
    """Return the weights of pairwise projection in the order of the views in the step."""
    return column_sums(projected_rows(question))


def soft(question: Question) -> Vector:
    """Return the weights of projection with a threshold and a strength."""
    threshold, strength = (number(question.options[n]) for n in ("threshold", "strength"))
    return column_sums(projected_rows(question, threshold=threshold, strength=strength))


def anchors(question: Question) -> Vector:
    """Return the weights of projection between a near and a far view only."""
    pair = set(question.labels) == {question.options["near"], question.options["far"]}
    return symmetric(question) if pair else sum_of(question)


def confgate(question: Question) -> Vector:
    """Return the weights of projection for pairs whose average cosine shows a conflict."""
    cosine = cosines(question.gramian)
    confident = {
        (i, j): i != j
        and abs(cosine[i][j]) > number(UNRELATED)
        and _believed(question, (question.places[i], question.places[j]), cosine[i][j])
        for i in range(question.count)
        for j in range(question.count)
    }
    return column_sums(projected_rows(question, lambda i, j: confident[i, j]))


def _believed(question: Question, pair: tuple[int, int], cosine: Number) -> bool:
    """Return True if a pair has probably conflicted for some time, including this step."""
    mp, options = require_mpmath().mp, question.options
    beta = number(options["beta"])
    tau = {"v2": 0.9, "low": 0.6}[options["variant"]] if options["tau"] is None else options["tau"]
    seen: tuple[Number, Number, int] = question.memory.get(pair, (number(0), number(0), 0))
    first = beta * seen[0] + (1 - beta) * cosine
    second = beta * seen[1] + (1 - beta) * cosine**2
    updates = seen[2] + 1
    question.memory[pair] = (first, second, updates)
    missing = 1 - beta**updates
    mean = first / missing
    variance = max(second / missing - mean**2, number(0))
    score = -mean / mp.sqrt(variance * (1 - beta) / (1 + beta) + number("1e-12"))
    return bool(mp.ncdf(score) >= tau) and updates > options["warmup"]


def gradvac(question: Question) -> Vector:
    """Return the weights of GradVac with stored targets.

    The random order is the order of the operator.
    """
    rows = [
        _aligned(question, i, partners)
        for i, partners in enumerate(partners_of(question, shuffled=True))
    ]
    return column_sums(rows)


def _aligned(question: Question, i: int, partners: Sequence[int]) -> Vector:
    mp, beta, limit = require_mpmath().mp, number(question.options["beta"]), number("0.999")
    norms = lengths(question.gramian)
    row = _Combination(question.gramian, norms, i)
    length = row.length
    for j in partners:
        key = (question.places[i], question.places[j])
        t: Number = question.memory.get(key, number(0))
        phi = min(max(row.products[j] / length / norms[j], -1), 1)
        question.memory[key] = min(max((1 - beta) * t + beta * phi, -limit), limit)
        if phi >= t:
            continue
        if 1 + phi <= number(OPPOSITE):
            return zeros(question.count)
        root = mp.sqrt(1 - t * t)
        row.add(j, length * (t * mp.sqrt(1 - phi**2) - phi * root) / (norms[j] * root))
        length = row.length
        if not length:
            return zeros(question.count)
    return row.v


def gradnorm(question: Question) -> Vector:
    """Return the weights of GradNorm if the losses of all groups keep their initial values."""
    mp = require_mpmath().mp
    groups = list(dict.fromkeys(question.labels))
    members = {g: [i for i, label in enumerate(question.labels) if label == g] for g in groups}
    n, norms = lengths(question.gramian), {}
    for group, inside in members.items():
        indicator = [number(int(k in inside)) for k in range(question.count)]
        square, longest = form(question.gramian, indicator), max(n[k] for k in inside)
        norms[group] = number(0) if cancels(square, longest) else mp.sqrt(square)
    groups = [g for g in groups if norms[g] > 0]
    logs = {g: question.memory.get(g, number(0)) for g in groups}
    weights = _adding_up(logs)
    mean = sum(weights[g] * norms[g] for g in groups) / max(len(groups), 1)
    if len(groups) > 1:
        step = number(question.options["lr"])
        off = {g: weights[g] * norms[g] - mean for g in groups}
        signs = {g: mp.sign(v) if abs(v) > number("1e-9") * mean else 0 for g, v in off.items()}
        logs = {g: mp.log(weights[g]) - step * signs[g] for g in groups}
    question.memory.update({g: mp.log(w) for g, w in _adding_up(logs).items()})
    return [weights.get(label, number(1)) for label in question.labels]


def _adding_up(logs: Mapping[str, Number]) -> dict[str, Number]:
    mp = require_mpmath().mp
    total = sum(mp.exp(log) for log in logs.values())
    return {g: mp.exp(log) * len(logs) / total for g, log in logs.items()}
