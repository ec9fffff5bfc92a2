"""Print how much the test PSNR varies at the end of finished runs, as a table.

    crossgrad sweep benchmarks/grids/steady_ends.yaml --scene SCENE
    python benchmarks/steady_ends.py runs/sweeps/steady_ends

For each run, a straight line is fitted to the PSNR of the evaluations in the last tenth of the
steps. The jitter is the standard deviation from this line. This script does not import torch.
"""

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

import numpy as np

from crossgrad_core.run.results.reading import RunResults, find_runs, read_run

#: Minimum number of evaluations in the last tenth of a run that are needed to compute the jitter.
FEWEST = 10
LAST = 0.1


def jitter(steps: Sequence[float], values: Sequence[float]) -> float:
    """Return the standard deviation of values from their straight line over the steps.

    The fit of the line uses two degrees of freedom. The result has the unit of the values.
    """
    x, y = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    rest = y - np.polyval(np.polyfit(x - x.mean(), y, 1), x - x.mean())
    return float(np.sqrt((rest**2).sum() / (len(y) - 2)))


def last_tenth(run: RunResults) -> tuple[list[float], list[float]]:
    """Return steps and PSNR of the evaluations in the last tenth of a run."""
    total = max(float(row["step"] or 0) for row in run.rows)
    rows = [row for row in run.rows if float(row["step"] or 0) > (1.0 - LAST) * total]
    known = [(row["step"], row["psnr"]) for row in rows]
    pairs = [(float(x), float(y)) for x, y in known if x is not None and y is not None]
    return [x for x, _ in pairs], [y for _, y in pairs]


def arm(run: RunResults) -> tuple[str, str, str, str]:
    """Return scene and growth mode of a run, and the rules that act at its end."""
    rules = dict(run.config.get("rules") or {})
    tail, average = (rules.get(name) or {} for name in ("lr-tail", "weight-averaging"))
    fades, averages = (float(each.get("share", 0.0)) for each in (tail, average))
    left = f" to {tail['factor']:g}" if fades else ""
    growth = str(run.config.get("growth") or "unbounded")
    return Path(str(run.config["scene"])).name, growth, f"{fades:.0%}{left}", f"{averages:.0%}"


def main() -> None:
    """Print a line per scene and arm."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    found = defaultdict(list)
    for folder in parser.parse_args().folders:
        for path in find_runs(folder):
            run = read_run(path)
            steps, values = last_tenth(run) if run.summary is not None else ([], [])
            if len(steps) >= FEWEST:
                found[arm(run)].append((jitter(steps, values), values[-1], len(steps)))
    heads = ("scene", "growth", "rates fade over", "averaged", "runs", "evaluations")
    print(f"| {' | '.join(heads)} | jitter, dB | last PSNR, dB |")
    print("|---" * (len(heads) + 2) + "|")
    for (scene, growth, fades, averages), runs in sorted(found.items()):
        jitters, last, counts = zip(*runs, strict=True)
        print(
            f"| {scene} | {growth} | {fades} | {averages} | {len(runs)} | {min(counts)} | "
            f"{mean(jitters):.3f} (at most {max(jitters):.3f}) | {mean(last):.2f} |"
        )


if __name__ == "__main__":
    main()
