"""The table of a probe: one row per metric and block."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.conflict import conflict
from crossgrad_plugins.diagnostics.distances import conflict_by_distance
from crossgrad_plugins.diagnostics.exponent import distance_exponent
from crossgrad_plugins.diagnostics.grouped import Groups
from crossgrad_plugins.diagnostics.intervals.interval import Interval
from crossgrad_plugins.diagnostics.intervals.intervals import split_intervals
from crossgrad_plugins.diagnostics.noise_scale import noise_scale
from crossgrad_plugins.diagnostics.plan import ProbePlan
from crossgrad_plugins.diagnostics.probe import Measurement
from crossgrad_plugins.diagnostics.ratios import geometric_mean, gradient_ratio
from crossgrad_plugins.diagnostics.variance import variance_split

Row: TypeAlias = Mapping[str, str | int | float]

#: All blocks taken as one vector.
ALL = "all"
#: The paper's R_op+DC is taken on these two together.
AMPLITUDES = ("opacities", "f_dc")


@dataclass(frozen=True, eq=False)
class _Part:
    """A block, or several taken as one vector.

    Attributes:
        name: Its name.
        kind: Its kind.
        members: Places of its blocks in the measurement.
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
    """The rows of one probe.

    Args:
        measurement: The Gramians.
        plan: The groups.
        distances: Name -> [N] distance of every training view; an exponent is fitted to each.
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
    """Every block, the amplitudes together, and everything together."""
    blocks = measurement.blocks
    for place, (name, kind) in enumerate(zip(blocks, measurement.kinds, strict=True)):
        yield _Part(name, kind, (place,))
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
    """Conflict, ratios and variances of a part from its blocks' Gramians [M, V, V]."""
    total = gramians.sum(axis=0)
    overlap: NDArray[np.bool_] = np.any(measurement.overlap[list(part.members)], axis=0)
    clashes = conflict(total[None], near, overlap[None])
    ratio = gradient_ratio(np.diag(total), near)
    each = tuple(gradient_ratio(np.diag(gramian), near).of_means for gramian in gramians)
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
        "ratio_geometric": geometric_mean(each),
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
    """Exponents and conflict against distance."""
    row: dict[str, str | int | float] = {}
    for name, values in distances.items():
        fit = distance_exponent(np.diag(gramian), values)
        row[f"exponent_{name}"] = fit.value
        row |= _ends(f"exponent_{name}", fit.interval)
        found = conflict_by_distance(gramian, values, rng)
        row[f"conflict_correlation_{name}"] = found.correlation
        row[f"conflict_p_{name}"] = found.p_value
        row |= {f"conflict_{name}_bin{b + 1}": float(r) for b, r in enumerate(found.rates)}
    return row


def _ends(name: str, interval: Interval) -> dict[str, float]:
    return {f"{name}_low": interval.low, f"{name}_high": interval.high}


def per_pair_conflict(measurement: Measurement, near: NDArray[np.bool_]) -> float:
    """The other reading of the conflict rate: share of a pair's blocks, averaged over pairs."""
    return conflict(measurement.plain, near, measurement.overlap).per_pair


def touched(rows: Sequence[Row]) -> list[Row]:
    """The rows of blocks that any view touched; the others (inactive SH bands) have no figures."""
    return [row for row in rows if float(row["sigma_w2"]) != 0.0]


def rows_of(rows: Sequence[Row], metric: str) -> list[Row]:
    """The rows of one metric."""
    return [row for row in rows if row["metric"] == metric]
