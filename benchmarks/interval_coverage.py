"""Measure the coverage of the intervals of sigma_w^2, sigma_b^2 and their ratio.

    python benchmarks/interval_coverage.py [repetitions] [noise ...]

The program prints the share of repetitions in which an interval contains the true value (nominally
95 %). The rows differ by kind of noise, dimension of the gradients, number of near and far views,
and true ratio sigma_b^2 / sigma_w^2.

`normal`: independent normal components; `decaying`: standard deviations decrease like 1/sqrt(k), so
that few directions dominate; `student3`: independent components of Student's t with 3 degrees of
freedom; `radial5`: multivariate t with 5 degrees of freedom, one factor per view, so that the norms
of the views are heavy-tailed; `lognormal`: normal components times a log-normal factor per view
(sigma 0.5); `finite`: a population of 40 + 40 views, from which the views are drawn without
replacement, like the probe of a scene.
"""

import sys
from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import Groups
from crossgrad_plugins.diagnostics.intervals import split_intervals

HEAVY = ("student3", "radial5", "lognormal")
KINDS = ("normal", "decaying", *HEAVY, "finite")
DIMENSIONS = (3, 30, 300)
SIZES = ((8, 8), (12, 12), (8, 24))
RATIOS = (0.1, 1.0)
POPULATION = 40
LOG_SIGMA = 0.5


def noise(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return deviations [n, P] with mean zero and mean squared length P."""
    normal = rng.normal(size=shape)
    if kind == "student3":
        return np.asarray(rng.standard_t(3, size=shape) / np.sqrt(3.0))
    if kind == "radial5":
        return np.asarray(normal * np.sqrt(3.0 / rng.chisquare(5, size=(shape[0], 1))))
    if kind == "lognormal":
        factors = np.exp(LOG_SIGMA * rng.normal(size=(shape[0], 1)) - LOG_SIGMA**2)
        return np.asarray(normal * factors)
    if kind == "decaying":
        deviations = 1.0 / np.sqrt(1.0 + np.arange(shape[1]))
        return np.asarray(normal * deviations / np.sqrt((deviations**2).mean()))
    return normal


def coverage(
    kind: str,
    dimension: int,
    sizes: tuple[int, int],
    ratio: float,
    repetitions: int,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return the shares of repetitions whose (within, between, ratio) intervals are correct."""
    rng = np.random.default_rng(seed)
    common = 3.0 * rng.normal(size=dimension)
    gap = rng.normal(size=dimension)
    gap *= np.sqrt(4.0 * ratio * dimension) / np.linalg.norm(gap)
    near = np.arange(sum(sizes)) < sizes[0]
    truths = (float(dimension), ratio * dimension, ratio)
    groups = Groups(near)
    populations: list[NDArray[np.float64]] = []
    if kind == "finite":
        groups = Groups(near, cameras=(POPULATION, POPULATION))
        populations = [noise(kind, (POPULATION, dimension), rng) for _ in sizes]
        populations[1] += gap
        truths = _population_truths(populations)
    held = np.zeros(3)
    for _ in range(repetitions):
        if populations:
            parts = [rng.permutation(p)[:n] for p, n in zip(populations, sizes, strict=True)]
        else:
            parts = [noise(kind, (n, dimension), rng) for n in sizes]
            parts[1] += gap
        gradients = np.concatenate(parts) + common
        found = split_intervals(gradients @ gradients.T, groups, rng, resamples=499)
        intervals = (found.within, found.between, found.ratio)
        held += [i.holds(truth) for i, truth in zip(intervals, truths, strict=True)]
    return held / repetitions


def _population_truths(populations: list[NDArray[np.float64]]) -> tuple[float, float, float]:
    means = [population.mean(axis=0) for population in populations]
    squares = [((p - m) ** 2).sum(axis=1).mean() for p, m in zip(populations, means, strict=True)]
    within = float(np.mean(squares))
    between = float(((means[0] - means[1]) ** 2).sum()) / 4.0
    return within, between, between / within


def cases(kinds: Sequence[str]) -> Iterable[tuple[str, int, tuple[int, int], float]]:
    """Return the rows of the table."""
    return product(kinds or KINDS, DIMENSIONS, SIZES, RATIOS)


def main() -> None:
    """Print the table."""
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(f"share of {repetitions} repetitions whose 95 % interval contains the true value, in %")
    print(f"{'noise':<10}{'P':>5}{'views':>9}{'ratio':>7}{'within':>9}{'between':>9}{'ratio':>7}")
    for kind, dimension, sizes, ratio in cases(sys.argv[2:]):
        within, between, quotient = 100.0 * coverage(kind, dimension, sizes, ratio, repetitions)
        views = f"{sizes[0]}+{sizes[1]}"
        print(
            f"{kind:<10}{dimension:>5}{views:>9}{ratio:>7}"
            f"{within:>9.1f}{between:>9.1f}{quotient:>7.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
