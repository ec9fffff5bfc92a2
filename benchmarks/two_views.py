"""Compare two views per step with one view: the tables of docs/results/two-views.md.

    crossgrad sweep benchmarks/grids/two_views_tuning.yaml
    crossgrad sweep benchmarks/grids/two_views_tuning.yaml --best benchmarks/grids/two_views.yaml
    crossgrad sweep benchmarks/grids/two_views.yaml
    python benchmarks/two_views.py runs/sweeps/two-views-best > tables.md

Each arm occurs twice: with its best learning-rate factor on each scene, and with the published
learning rates. Differences are paired by scene and seed. Verdicts are computed as in `crossgrad
compare` and corrected over each table. This script does not import torch.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from _paper_verdicts import figure_of
from arms import REGIMES, Runs, arms, head, read

from crossgrad_plugins.compare.contrasts import Contrast, judged
from crossgrad_plugins.compare.narrative import needed_text, verdict_text
from crossgrad_plugins.compare.statistics import Verdict

ONE, TWO = "one view", "two views"
#: Quantity that is equal in a comparison -> its two arms; the arm with two views is first.
PAIRS = {
    "seconds": (f"{TWO}, equal seconds", f"{ONE}, equal seconds"),
    "views, events and count": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, stretched",
    ),
    "views, one view's schedule flat": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, flat",
    ),
    "views, statistics of one view": (
        f"{TWO}, equal views, statistics of one view",
        f"{ONE}, equal views, stretched",
    ),
    "views, statistics of two views": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, statistics of an extra render",
    ),
}
#: Title of a table -> last part of the names of the arms in it.
RATES = {"at the best rates": ", best", "at the published rates": ""}


def differences(runs: Runs, ending: str) -> Iterator[str]:
    """Yield the table of differences, for equal steps, views or seconds, and by regime."""
    scenes = runs.scenes
    yield from head("two views minus one, at equal ...", "regime", *scenes, "pooled", "verdict")
    wanted = [
        (title, runs.difference(first + ending, second + ending, regime))
        for title, (first, second) in PAIRS.items()
        for regime in REGIMES
    ]
    titles = [title for title, found in wanted if found.estimate is not None]
    for title, found in zip(titles, judged(found for _, found in wanted), strict=True):
        own = [[p.difference for p in found.pairs if p.scene == scene] for scene in scenes]
        cells = [f"{fmean(each):+.2f}" if each else "" for each in own]
        yield f"| {title} | {found.where} | {' | '.join(cells)} | {pooled(found)} |"


def pooled(found: Contrast) -> str:
    """Return two cells: the pooled difference with its interval, and the verdict."""
    verdict = verdict_text(found)
    if found.verdict is Verdict.INCONCLUSIVE:
        verdict += f": {needed_text(found)}"
    return f"{figure_of(found)} | {verdict}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", type=Path, nargs="+")
    given = parser.parse_args()
    runs = read(given.sweeps)
    for title, ending in RATES.items():
        print(f"### Two views minus one, {title}\n")
        print("\n".join(differences(runs, ending)), end="\n\n")
    print("### All arms\n")
    print("\n".join(arms(runs)))


if __name__ == "__main__":
    main()
