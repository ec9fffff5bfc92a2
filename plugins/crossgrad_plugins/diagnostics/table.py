"""The table of a probe: one row per metric and block."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from crossgrad_plugins.diagnostics.distances import conflict_by_distance
from crossgrad_plugins.diagnostics.grouped import (
    Groups,
    geometric_mean,
    gradient_ratio,
    variance_split,
)
from crossgrad_plugins.diagnostics.intervals import UNKNOWN, Interval, split_intervals
from crossgrad_plugins.diagnostics.plan import ProbePlan
from crossgrad_plugins.diagnostics.probe import Measurement


@dataclass(frozen=True, eq=False)
class Conflict:
    """Conflict between gradients, over all pairs of a near and a far view.

    A pair counts for a block if both gradients are non-zero and overlap in at least one element.
    Gradients that do not overlap are orthogonal, which does not mean that the views agree.

    Attributes:
        per_block: [B] share of the counted pairs with a negative dot product; NaN without pairs.
        per_pair: Share of conflicting blocks among the counted blocks of a pair, averaged over
            pairs; NaN without pairs.
        pairs: [B] number of counted pairs.
        disjoint: [B] number of pairs whose gradients are non-zero and do not overlap.
        zero: [B] number of pairs that contain a zero gradient.
    """

    per_block: NDArray[np.float64]
    per_pair: float
    pairs: NDArray[np.int64]
    disjoint: NDArray[np.int64]
    zero: NDArray[np.int64]


def conflict(
    gramians: NDArray[np.float64],
    near: NDArray[np.bool_],
    overlap: NDArray[np.bool_] | None = None,
) -> Conflict:
    """Compute the conflict rate in both definitions that the paper's "33-83 %" can have.

    Args:
        gramians: [B, V, V] dot products of gradients.
        near: [V] bool, True for views of the near group; all other views are far.
        overlap: [B, V, V] True for pairs whose gradients overlap. By default, every pair with a
            non-zero dot product overlaps.
    """
    products = gramians[:, near][:, :, ~near]
    norms = np.einsum("bii->bi", gramians)
    nonzero = (norms[:, near, None] > 0.0) & (norms[:, None, ~near] > 0.0)
    meets = products != 0.0 if overlap is None else overlap[:, near][:, :, ~near]
    counted = nonzero & meets
    negative = counted & (products < 0.0)
    return Conflict(
        per_block=_share(negative.sum(axis=(1, 2)), counted.sum(axis=(1, 2))),
        per_pair=_mean(_share(negative.sum(axis=0), counted.sum(axis=0))),
        pairs=counted.sum(axis=(1, 2)),
        disjoint=(nonzero & ~meets).sum(axis=(1, 2)),
        zero=(~nonzero).sum(axis=(1, 2)),
    )


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return part / whole; NaN if `whole` is 0."""
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _mean(values: NDArray[np.float64]) -> float:
    """Return the mean without NaN values; NaN if all values are NaN."""
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if len(valid) else float("nan")


#: Minimum number of views for the fit of a line and for the scatter around it.
_SMALLEST = 4


@dataclass(frozen=True)
class Exponent:
    """Exponent d in ||gradient|| ~ r^-d with distance r; positive if near gradients are longer.

    Attributes:
        value: The fitted exponent; NaN if it is undefined.
        interval: Confidence interval of the exponent.
        views: Number of views whose gradient and distance are non-zero.
    """

    value: float
    interval: Interval
    views: int


def distance_exponent(
    squared: NDArray[np.float64], distances: NDArray[np.float64], level: float = 0.95
) -> Exponent:
    """Fit a least-squares line of log length over log distance, with an interval of its slope.

    The interval is also valid if the scatter is not equal at all distances.

    Args:
        squared: [V] squared gradient lengths of one block.
        distances: [V] camera distances, any unit.
        level: Confidence level.

    Source: the paper, Proposition 1. Prediction P1: the exponent is larger for geometry than for
    amplitudes. Prediction P4: this holds only if the distance matches the visual scale. Standard
    error: HC3, MacKinnon and White 1985.
    """
    kept = (squared > 0.0) & (distances > 0.0)
    views = int(kept.sum())
    x, y = np.log(distances[kept]), np.log(squared[kept]) / 2.0
    if views < _SMALLEST or float(np.ptp(x)) == 0.0:
        return Exponent(float("nan"), UNKNOWN, views)
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    residuals = y - y.mean() - slope * centred
    leverage = np.minimum(1.0 / views + centred**2 / spread, 1.0 - 1e-9)
    error = float(np.sqrt(((centred * residuals / (1.0 - leverage)) ** 2).sum())) / spread
    reach = float(t.ppf((1.0 + level) / 2.0, views - 2)) * error
    return Exponent(-slope, Interval(-slope - reach, -slope + reach), views)


def noise_scale(gramian: NDArray[np.float64], groups: Groups) -> float:
    """Estimate tr(Sigma) / ||mean gradient||^2 of one block; both parts are unbiased.

    If K is far below the noise scale, K views per step are worth about as much as K steps. If K is
    far above the noise scale, further views are wasted. Mean and covariance Sigma refer to the
    mixture of the two groups with their weights. The result is infinite if the mean gradient cannot
    be distinguished from zero, and NaN if there is no variance.

    Args:
        gramian: [V, V] dot products of gradients.
        groups: The near views, and the weights of the groups.

    Source: McCandlish et al. 2018, the simple noise scale.
    """
    split = variance_split(gramian, groups)
    variance = split.within + split.between
    signal = _squared_mean(gramian, groups)
    if variance <= 0.0:
        return float("nan")
    return variance / signal if signal > 0.0 else float("inf")


def _squared_mean(gramian: NDArray[np.float64], groups: Groups) -> float:
    """Estimate ||p near mean + q far mean||^2 without bias; p and q are the group weights."""
    near, (n, m), (p, q) = groups.near, groups.sizes, groups.shares
    weights = np.where(near, p / n, q / m)
    plain = float(weights @ gramian @ weights)
    noise = 0.0
    for members, size, share, unseen in (
        (near, n, p, groups.unseen[0]),
        (~near, m, q, groups.unseen[1]),
    ):
        group_gramian = gramian[np.ix_(members, members)]
        spread = (float(np.trace(group_gramian)) - float(group_gramian.sum()) / size) / (size - 1)
        noise += share**2 * unseen * spread / size
    return plain - noise


Row: TypeAlias = Mapping[str, str | int | float]
#: Name of the part that contains all blocks as one vector.
ALL = "all"
#: The paper's R_op+DC contains these two blocks as one vector.
AMPLITUDES = ("opacities", "f_dc")


@dataclass(frozen=True, eq=False)
class _Part:
    """A block, or several blocks that are concatenated into one vector.

    Attributes:
        name: Name of the part.
        kind: Kind of the part.
        members: Indices of the blocks of this part in the measurement.
    """

    name: str
    kind: str
    members: tuple[int, ...]


def table(
    measurement: Measurement,
    plan: ProbePlan,
    distances: Mapping[str, NDArray[np.float64]],
    seed: int,
) -> list[Row]:
    """Return the rows of one probe.

    Args:
        measurement: The Gramians.
        plan: The probed views and their groups.
        distances: Name of a distance -> [N] its values for every training view; an exponent is
            fitted to each.
        seed: Seed of the bootstrap and of the permutations.
    """
    near = plan.near(measurement.views)
    places = list(measurement.views)
    seen = {name: values[places] for name, values in distances.items()}
    metrics = {"plain": measurement.plain}
    if measurement.adam is not None:
        metrics["adam"] = measurement.adam
    rng = np.random.default_rng(seed)
    return [
        {
            "step": measurement.step,
            "grouping": plan.grouping,
            "metric": metric,
            "block": part.name,
            "kind": part.kind,
            **_block(gramians[list(part.members)], measurement, part, near, plan, rng),
            **_distances(gramians[list(part.members)].sum(axis=0), seen, rng),
        }
        for metric, gramians in metrics.items()
        for part in _parts(measurement)
    ]


def _parts(measurement: Measurement) -> Iterator[_Part]:
    """Yield every block, then all amplitudes as one part, then all blocks as one part."""
    blocks = measurement.blocks
    for index, (name, kind) in enumerate(zip(blocks, measurement.kinds, strict=True)):
        yield _Part(name, kind, (index,))
    if set(AMPLITUDES) <= set(blocks):
        members = tuple(blocks.index(name) for name in AMPLITUDES)
        yield _Part("+".join(AMPLITUDES), "appearance", members)
    yield _Part(ALL, "neutral", tuple(range(len(blocks))))


def _block(
    gramians: NDArray[np.float64],
    measurement: Measurement,
    part: _Part,
    near: NDArray[np.bool_],
    plan: ProbePlan,
    rng: np.random.Generator,
) -> Row:
    """Return conflict, ratios and variances of a part from the Gramians [M, V, V] of its blocks."""
    total = gramians.sum(axis=0)
    overlap: NDArray[np.bool_] = np.any(measurement.overlap[list(part.members)], axis=0)
    clashes = conflict(total[None], near, overlap[None])
    ratio = gradient_ratio(np.diag(total), near)
    ratios = tuple(gradient_ratio(np.diag(gramian), near).of_means for gramian in gramians)
    groups = Groups(near)
    split = variance_split(total, groups)
    exact = variance_split(total, Groups(near, cameras=plan.cameras))
    intervals = split_intervals(total, groups, rng)
    return {
        "near_views": groups.sizes[0],
        "far_views": groups.sizes[1],
        "conflict_rate": float(clashes.per_block[0]),
        "pairs": int(clashes.pairs[0]),
        "disjoint_pairs": int(clashes.disjoint[0]),
        "zero_pairs": int(clashes.zero[0]),
        "ratio_of_means": ratio.of_means,
        "ratio_median": ratio.median,
        "ratio_geometric": geometric_mean(ratios),
        "sigma_w2": split.within,
        **_ends("sigma_w2", intervals.within),
        "sigma_b2": split.between,
        **_ends("sigma_b2", intervals.between),
        "rho": split.ratio,
        **_ends("rho", intervals.ratio),
        "sigma_w2_of_these_cameras": exact.within,
        "sigma_b2_of_these_cameras": exact.between,
        "noise_scale": noise_scale(total, groups),
    }


def _distances(
    gramian: NDArray[np.float64],
    distances: Mapping[str, NDArray[np.float64]],
    rng: np.random.Generator,
) -> Row:
    """Return the exponents, and the relation between conflict and distance."""
    row: dict[str, str | int | float] = {}
    for name, values in distances.items():
        fit = distance_exponent(np.diag(gramian), values)
        row[f"exponent_{name}"] = fit.value
        row |= _ends(f"exponent_{name}", fit.interval)
        by_distance = conflict_by_distance(gramian, values, rng)
        row[f"conflict_correlation_{name}"] = by_distance.correlation
        row[f"conflict_p_{name}"] = by_distance.p_value
        row |= {f"conflict_{name}_bin{b + 1}": float(r) for b, r in enumerate(by_distance.rates)}
    return row


def _ends(name: str, interval: Interval) -> dict[str, float]:
    return {f"{name}_low": interval.low, f"{name}_high": interval.high}


def per_pair_conflict(measurement: Measurement, near: NDArray[np.bool_]) -> float:
    """Return the share of a pair's blocks that conflict, averaged over pairs."""
    return conflict(measurement.plain, near, measurement.overlap).per_pair


def touched(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of blocks with variance.

    Other blocks, such as inactive SH bands, have no values.
    """
    return [row for row in rows if float(row["sigma_w2"]) != 0.0]


def rows_of(rows: Sequence[Row], metric: str) -> list[Row]:
    """Return the rows of one metric."""
    return [row for row in rows if row["metric"] == metric]
