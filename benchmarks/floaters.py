"""Held-out photos of finished runs with their floaters and without: a table.

    crossgrad run SCENE --seconds 600 --floaters keep --out RUN
    python benchmarks/floaters.py RUN ...

Floaters of all runs are sought in the same way, whatever the run was asked to do with them; a run
that removed them has none left. Nothing is written to the runs.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import torch

from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.evaluation.result import EvaluationResult
from crossgrad_core.run.export import renderer
from crossgrad_core.run.opening import opened
from crossgrad_core.training.floaters import EMPTY, floaters, in_empty_space, remove_floaters
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.steady import shown

_METRICS = ("psnr", "psnr_cc")


def measured(setup: Setup, state: TrainState) -> EvaluationResult:
    """The figures of the held-out views."""
    return evaluate(
        setup.scene.test_views,
        renderer(setup, state),
        setup.metrics,
        points=setup.scene.points,
    )


def row(folder: Path, empty: float) -> Sequence[str]:
    """A run's line: what was removed, how long that took, and what it did to held-out photos."""
    setup, state = opened(folder, {})
    primitives = state.primitives(setup)
    positions = shown(state)[setup.backbone.positions].detach().double().cpu().numpy()
    near = int(in_empty_space(positions, setup.scene, empty).sum())
    before = measured(setup, state)
    floaters(setup, state, empty)  # Compiles what is to be timed.
    start = perf_counter()
    removed = remove_floaters(setup, state, empty)
    seconds = perf_counter() - start
    after = measured(setup, state)
    pairs = zip(before.views, after.views, strict=True)
    changes = [float(b.values["psnr"] or 0.0) - float(a.values["psnr"] or 0.0) for a, b in pairs]
    means = [f"{result.overall[name]:.2f}" for name in _METRICS for result in (before, after)]
    counts = f"{primitives:,}", f"{near:,}", f"{removed:,}"
    return [
        setup.scene.name, str(state.step), *counts, f"{seconds:.2f}", *means,
        f"{min(changes):+.2f} to {max(changes):+.2f}",
    ]  # fmt: skip


def main() -> None:
    """Prints a line per run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument(
        "--empty", type=float, default=EMPTY, metavar="SHARE",
        help="of the way to the nearest that a camera sees; inf: everywhere",
    )  # fmt: skip
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    print(
        "| scene | steps | primitives | before cameras | floaters | s | PSNR with | without "
        "| after colour correction, with | without | single photos |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for folder in arguments.runs:
        print("| " + " | ".join(row(folder, arguments.empty)) + " |", flush=True)


if __name__ == "__main__":
    main()
