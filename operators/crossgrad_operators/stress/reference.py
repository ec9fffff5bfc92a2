"""The oracle of each operator, and the oracle's result for a case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from crossgrad_operators.stress import oracles, solvers
from crossgrad_operators.stress.exact import Matrix, Number, apply, number, require_mpmath
from crossgrad_operators.stress.oracles import Oracle, Question, column_sums

#: Name of an operator -> its oracle. Other operators are checked without an oracle.
ORACLES: Final[Mapping[str, Oracle]] = {
    "sum": oracles.sum_of,
    "mean": oracles.mean_of,
    "symmetric": oracles.symmetric,
    "pcgrad": oracles.pcgrad,
    "gradvac": oracles.gradvac,
    "cagrad": solvers.cagrad,
    "mgda": solvers.mgda,
    "gradnorm": oracles.gradnorm,
    "imtl-g": solvers.imtl_g,
    "nash": solvers.nash,
    "aligned": solvers.aligned,
    "upgrad": solvers.upgrad,
    "dualproj": solvers.dualproj,
    "preconditioner": oracles.preconditioned,
    "confgate": oracles.confgate,
    "anchors": oracles.anchors,
    "soft": oracles.soft,
    "dispatch": oracles.symmetric,
}

#: Options with which operators change gradients from the first step on.
OPTIONS: Final[Mapping[str, Mapping[str, Any]]] = {
    "confgate": {"warmup": 0},
    "soft": {"threshold": 0.25, "strength": 0.5},
    "dispatch": {"variant": "geometry-projection"},
    "chain": {"links": ["preconditioner", "symmetric", "mean"]},
}


def chained(question: Question) -> list[Number]:
    """Return the weights of the chain in `OPTIONS`.

    The chain preconditions, then projects, then averages.
    """
    factors = oracles.preconditioned(Question(**{**vars(question), "options": {"geometry": 2.0}}))
    inner = _between(question.gramian, factors)
    rows = oracles.projected_rows(Question(**{**vars(question), "gramian": inner}))
    weights = column_sums(rows)
    return [w * f / question.views for w, f in zip(weights, factors, strict=True)]


def _between(gramian: Matrix, factors: Sequence[Number]) -> Matrix:
    return [
        [v * factors[i] * factors[j] for j, v in enumerate(row)] for i, row in enumerate(gramian)
    ]


@dataclass(frozen=True, eq=False)
class Answer:
    """The result of exact arithmetic.

    Attributes:
        weights: [K] weights; zero for views without a gradient.
        length: Length |u| of the result.
        largest: Length of the longest weighted gradient, max |w_k| |g_k|.
    """

    weights: list[Number]
    length: Number
    largest: Number


def answer(
    oracle: Oracle,
    gramian: Matrix,
    views: "Views",
    memory: dict[Any, Any],
    options: Mapping[str, Any],
) -> Answer:
    """Return the oracle's result for all views that have a gradient."""
    mp = require_mpmath().mp
    places = [k for k in range(len(gramian)) if gramian[k][k] > 0]
    reduced_gramian = [[gramian[i][j] for j in places] for i in places]
    question = Question(
        gramian=reduced_gramian,
        places=places,
        views=len(gramian),
        options=options,
        labels=[views.labels[k] for k in places],
        ratios=[views.ratios[k] for k in places],
        rng=np.random.default_rng(views.seed),
        memory=memory,
    )
    weights = [number(0)] * len(gramian)
    if places:
        for k, w in zip(places, oracle(question), strict=True):
            weights[k] = w
    square = sum(w * v for w, v in zip(weights, apply(gramian, weights), strict=True))
    terms = [abs(w) * mp.sqrt(gramian[k][k]) for k, w in enumerate(weights)]
    return Answer(weights, mp.sqrt(max(square, number(0))), max(terms, default=number(0)))


@dataclass(frozen=True)
class Views:
    """Properties of K views that some operators read.

    Attributes:
        labels: [K] labels of the groups.
        ratios: [K] camera distances, divided by the reference distance.
        seed: Seed of the operator's random generator in this step.
    """

    labels: tuple[str, ...]
    ratios: tuple[float, ...]
    seed: int


def sample_views(count: int, seed: int = 0) -> Views:
    """Return views that are alternately near and far, at distances near the reference distance."""
    labels = tuple(("near", "far")[k % 2] for k in range(count))
    return Views(labels, tuple(0.5 + 0.25 * k for k in range(count)), seed)
