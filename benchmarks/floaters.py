"""Print a table of held-out photos of finished runs, before and after removal of floaters.

    crossgrad run SCENE --seconds 600 --no-rule floaters --out RUN
    python benchmarks/floaters.py RUN ...

The runs must still contain their floaters. The runs are not changed.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import torch

from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.evaluation.result import EvaluationResult
from crossgrad_core.run.export import renderer
from crossgrad_core.run.load_run import opened
from crossgrad_core.training.rules import eval_parameters
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.step import final_edits
from crossgrad_plugins.rules.floaters import Floaters, in_empty_space

_METRICS = ("psnr", "psnr_cc")
#: Changes of a photo below this value, in dB, are not shown.
SMALLEST = 0.005


def measured(setup: Setup, state: TrainState) -> EvaluationResult:
    """Return the metrics of the held-out views."""
    return evaluate(
        setup.scene.test_views,
        renderer(setup, state),
        setup.metrics,
        points=setup.scene.points,
    )


def row(folder: Path, empty: float) -> Sequence[str]:
    """Return a run's line: number of removed primitives, time, and changes of held-out photos."""
    setup, state = opened(folder, {})
    setup = setup.with_rules({"floaters": Floaters.model_construct(empty=empty)})
    primitives = state.primitives(setup)
    positions = (
        eval_parameters(setup, state)[setup.backbone.positions].detach().double().cpu().numpy()
    )
    near = int(in_empty_space(positions.double().cpu().numpy(), setup.scene, empty).sum())
    # This first call also compiles the code, so that the time below does not contain compilation.
    before = measured(setup, state)
    start = perf_counter()
    list(final_edits(setup, state))
    seconds = perf_counter() - start
    after = measured(setup, state)
    pairs = zip(before.views, after.views, strict=True)
    changes = [float(b.values["psnr"] or 0.0) - float(a.values["psnr"] or 0.0) for a, b in pairs]
    known = {figure.name for figure in before.figures}
    means = [
        f"{result.overall[name]:.2f}" if name in known else ""
        for name in _METRICS
        for result in (before, after)
    ]
    counts = f"{primitives:,}", f"{near:,}", f"{primitives - state.primitives(setup):,}"
    changed = max(map(abs, changes)) >= SMALLEST
    single = f"{min(changes):+.2f} to {max(changes):+.2f}" if changed else ""
    trained = f"{state.clock.train:.0f}"
    return [setup.scene.name, trained, *counts, f"{seconds:.2f}", *means, single]


def main() -> None:
    """Print a line per run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument(
        "--empty", type=float, default=Floaters().empty, metavar="SHARE",
        help="empty share of the distance to the nearest point that a camera sees; 1e9: no limit",
    )  # fmt: skip
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    print(
        "| scene | seconds | primitives | in empty space | floaters | s | PSNR with | without "
        "| after colour correction, with | without | single photos |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for folder in arguments.runs:
        print("| " + " | ".join(row(folder, arguments.empty)) + " |", flush=True)


if __name__ == "__main__":
    main()
