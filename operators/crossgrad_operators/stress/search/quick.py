"""The exact answers of many cases at once, in about 32 digits: what the search looks with.

Independent of the operators, as the 50-digit oracles are, which confirm what this finds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_operators.stress.search.batch import Batch, search_views
from crossgrad_operators.stress.search.numba_kernels import balance, convex
from crossgrad_operators.stress.search.numba_kernels.projection import projected

Floats = NDArray[np.float64]
Options = Mapping[str, Any]
Solved = tuple[Floats, Floats]
#: (batch, options of the operator) -> weights [B, K, 2] and trust [B].
Quick = Callable[[Batch, Options], Solved]

#: What ConfGate takes for the standard deviation of a cosine that it has seen once.
_DEVIATION: Final = 1e-6
#: Error of these answers relative to their largest term, where the smallest pivot is 1.
_ERROR: Final = 1e-30
#: The share of the unit roundoff that it may be.
_SHARE: Final = 0.01
#: Square of a label's sum, over that of its longest gradient, that GradNorm may take for zero.
_CANCELS: Final = 1e-9
#: Cosines that all pairs and that no pairs are below.
_ALL, _NONE = 2.0, -2.0


@dataclass(frozen=True, eq=False)
class Exact:
    """Exact answers.

    Attributes:
        weights: [B, K, 2] in 32 digits.
        proven: [B] where they are.
    """

    weights: Floats
    proven: NDArray[np.bool_]


def exact(quick: Quick, batch: Batch, options: Options) -> Exact:
    """The exact answers of a batch."""
    weights, trust = quick(batch, options)
    return Exact(weights, trust * _SHARE * batch.unit >= _ERROR)


def _order(views: int) -> NDArray[np.int64]:
    """[K, K] partners by slot."""
    return np.tile(np.arange(views), (views, 1))


def _shuffled_order(views: int) -> NDArray[np.int64]:
    """[K, K] partners in the random order of an operator with the search's generator."""
    rng = np.random.default_rng(search_views(views).seed)
    return _order(views) if views <= 2 else rng.permuted(_order(views), axis=1)  # noqa: PLR2004


def _projection(
    batch: Batch,
    order: NDArray[np.int64],
    *,
    limit: float = _ALL,
    soft: tuple[float, float] = (0.0, 1.0),
    divisor: float = 1.0,
) -> Solved:
    return projected(*batch.directions, batch.present, order, limit, *soft, divisor)


def _sum(batch: Batch, _options: Options) -> Solved:
    return _projection(batch, _order(batch.views), limit=_NONE)


def _mean(batch: Batch, _options: Options) -> Solved:
    return _projection(batch, _order(batch.views), limit=_NONE, divisor=float(batch.views))


def _symmetric(batch: Batch, _options: Options) -> Solved:
    return _projection(batch, _order(batch.views))


def _shuffled(batch: Batch, _options: Options) -> Solved:
    return _projection(batch, _shuffled_order(batch.views))


def _soft(batch: Batch, options: Options) -> Solved:
    rule = (options["threshold"], options["strength"])
    return _projection(batch, _order(batch.views), soft=rule)


def _confgate(batch: Batch, options: Options) -> Solved:
    tau = options["tau"] or {"v2": 0.9, "low": 0.6}[options["variant"]]
    limit = -_DEVIATION * NormalDist().inv_cdf(tau)
    return _projection(batch, _order(batch.views), limit=limit)


def _balanced(batch: Batch, options: Options) -> Solved:
    """GradNorm at its first step: the sum, unless the gradients of a label cancel."""
    weights, trust = _sum(batch, options)
    norms, cosines = (each[..., 0] for each in batch.directions)
    gramians = cosines * norms[:, :, None] * norms[:, None, :]
    labels = np.array(search_views(batch.views).labels)
    for label in dict.fromkeys(labels.tolist()):
        own = labels == label
        square = np.einsum("bij->b", gramians[:, own][:, :, own])
        trust = np.where(square > _CANCELS * norms[:, own].max(axis=1) ** 2, trust, -1.0)
    return weights, trust


def _factors(batch: Batch, power: float) -> Floats:
    """[K] (r / r_ref)^power: powers of two, which multiply without error."""
    return np.array(search_views(batch.views).ratios) ** power


def _preconditioned(batch: Batch, options: Options) -> Solved:
    weights, trust = _sum(batch, options)
    return weights * _factors(batch, options["geometry"])[:, None], trust


def _chained(batch: Batch, _options: Options) -> Solved:
    """The chain of `reference.OPTIONS`: precondition, project, average."""
    factors = _factors(batch, 2.0)[:, None]
    norms, cosines = batch.directions
    order = _order(batch.views)
    weights, trust = projected(
        norms * factors, cosines, batch.present, order, _ALL, 0.0, 1.0, float(batch.views)
    )
    return weights * factors, trust


def _cone(batch: Batch, *, apart: bool) -> Solved:
    return convex.on_cone(*batch.directions, batch.present, apart)


#: Operator name -> its quick reference, under `reference.OPTIONS` and at the first step.
QUICK: Final[Mapping[str, Quick]] = {
    "sum": _sum,
    "mean": _mean,
    "gradnorm": _balanced,
    "preconditioner": _preconditioned,
    "symmetric": _symmetric,
    "anchors": _symmetric,
    "dispatch": _symmetric,
    "pcgrad": _shuffled,
    "gradvac": _shuffled,
    "soft": _soft,
    "confgate": _confgate,
    "chain": _chained,
    "upgrad": lambda batch, _options: _cone(batch, apart=True),
    "dualproj": lambda batch, _options: _cone(batch, apart=False),
    "mgda": lambda batch, _options: convex.shortest(*batch.directions, batch.present),
    "cagrad": lambda batch, options: convex.on_simplex(
        *batch.directions, batch.present, options["c"]
    ),
    "nash": lambda batch, _options: balance.nash(*batch.directions, batch.present),
    "imtl-g": lambda batch, _options: balance.imtl_g(*batch.directions, batch.present),
    "aligned": lambda batch, _options: balance.aligned(*batch.directions, batch.present),
}
