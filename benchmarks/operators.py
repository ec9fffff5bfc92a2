"""Measure the cost of operators, compared with plain additions of the same gradients.

One JSON line per operator:

    python benchmarks/operators.py [OPERATOR ...] [--parameters N] [--repeats N]

The gradients are those of K = 2 and K = 4 views, each with `--parameters` float32 numbers in the
six blocks of a vanilla backbone. `ratio` is (time of the aggregation - time of the additions) /
time of the additions. The additions are `torch.add(g1, g2, out=)`, repeated for each further view.
Additions and aggregation are measured alternately. The aggregation overwrites the gradients of one
view, so these are restored before each repetition. `accumulated_ratio` is the ratio for operators
that need no separate gradients; the views are then added one by one, as in training.
`arithmetic_us` is the time of the operator's own arithmetic for six blocks, in microseconds. Times
are minima over the repetitions. `load` shows how much other work the machine had.
"""

import argparse
import json
from collections.abc import Callable
from time import perf_counter
from typing import Any, cast

import numpy as np
import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_core.contract.blocks import EMPTY_STATE, Block, BlockKind, LearningRate
from crossgrad_core.contract.contexts import AggregateContext
from crossgrad_core.contract.gradients import SeparateGradients
from crossgrad_core.contract.gramian_operator import MatrixOperator, operator_context
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.summed import SummedGradients
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import build, entries

#: Block -> number of elements per Gaussian, and kind, as in the vanilla backbone with SH degree 3.
WIDTHS: dict[str, tuple[int, BlockKind]] = {
    "means": (3, "geometry"),
    "scales": (3, "geometry"),
    "quats": (4, "geometry"),
    "opacities": (1, "appearance"),
    "f_dc": (3, "appearance"),
    "f_rest": (45, "appearance"),
}
BLOCKS = tuple(
    Block(name, (name,), True, kind, LearningRate(1.0)) for name, (_, kind) in WIDTHS.items()
)
ADDITIONS = "torch.add"


def main() -> None:
    """Print one line per operator."""
    arguments = _arguments()
    configure_threads()
    names = arguments.operators or list(entries("operators"))
    operators = {name: build(Operator, name, {}) for name in names}
    lines: dict[str, dict[str, Any]] = {name: {"operator": name} for name in operators}
    for views in (2, 4):
        for name, result in _measured(operators, views, arguments).items():
            lines[name] |= result
    for line in lines.values():
        print(json.dumps(line | {"peak_mib": peak_mib()} | facts()))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("operators", nargs="*", help="names; default: all installed")
    parser.add_argument("--parameters", type=int, default=7_000_000)
    parser.add_argument("--repeats", type=int, default=20)
    return parser.parse_args()


def _measured(
    operators: dict[str, Operator], views: int, arguments: argparse.Namespace
) -> dict[str, dict[str, float | None]]:
    kept = _gradients(views, arguments.parameters)
    gradients = _gradients(views, arguments.parameters)
    out = {name: torch.empty_like(gradient) for name, gradient in gradients[0].items()}
    results: dict[str, dict[str, float | None]] = {}
    for name, operator in operators.items():
        if not operator.views.admits(views):
            continue
        work = _work(operator, gradients, out)
        times = _least(work, arguments.repeats, lambda: _restore(kept, gradients))
        ratios = {
            f"{key}_k{views}": round(time / times[ADDITIONS] - 1.0, 3)
            for key, time in times.items()
            if key != ADDITIONS
        }
        results[name] = ratios | {
            f"aggregation_ms_k{views}": round(1e3 * times["ratio"], 3),
            f"additions_ms_k{views}": round(1e3 * times[ADDITIONS], 3),
            f"arithmetic_us_k{views}": _arithmetic(operator, views),
        }
    return results


def _work(
    operator: Operator, gradients: list[dict[str, Tensor]], out: dict[str, Tensor]
) -> dict[str, Callable[[], object]]:
    """Return the functions that are timed, by the name of the measured value."""
    work: dict[str, Callable[[], object]] = {
        "ratio": lambda: operator.aggregate(_context(_apart(gradients)), EMPTY_STATE),
        ADDITIONS: lambda: _add(gradients, out),
    }
    if not operator.separate:
        work["accumulated_ratio"] = lambda: operator.aggregate(
            _context(_accumulated(gradients)), EMPTY_STATE
        )
    return work


def _gradients(views: int, parameters: int) -> list[dict[str, Tensor]]:
    count = parameters // sum(width for width, _ in WIDTHS.values())
    generator = torch.Generator().manual_seed(0)
    return [
        {
            name: torch.randn(count, width, generator=generator)
            for name, (width, _) in WIDTHS.items()
        }
        for _ in range(views)
    ]


def _restore(kept: list[dict[str, Tensor]], gradients: list[dict[str, Tensor]]) -> None:
    for saved, changed in zip(kept, gradients, strict=True):
        for name, gradient in changed.items():
            gradient.copy_(saved[name])


def _add(gradients: list[dict[str, Tensor]], out: dict[str, Tensor]) -> None:
    for name, total in out.items():
        torch.add(gradients[0][name], gradients[1][name], out=total)
        for view in gradients[2:]:
            torch.add(total, view[name], out=total)


def _least(
    work: dict[str, Callable[[], object]],
    repeats: int,
    prepare: Callable[[], object] = lambda: None,
) -> dict[str, float]:
    """Return the minimum seconds of each function; the functions are called alternately."""
    least = dict.fromkeys(work, float("inf"))
    for repeat in range(repeats + 1):
        for name, run in work.items():
            prepare()
            start = perf_counter()
            run()
            if repeat:
                least[name] = min(least[name], perf_counter() - start)
    return least


def _apart(gradients: list[dict[str, Tensor]]) -> SeparateGradients:
    return DenseGradients(gradients, BLOCKS, overwrite=True)


def _accumulated(gradients: list[dict[str, Tensor]]) -> SeparateGradients:
    total = SummedGradients.empty(BLOCKS, len(gradients))
    for view in gradients:
        total.add(view)
    return total


def _context(gradients: SeparateGradients) -> AggregateContext:
    views = gradients.views
    return AggregateContext(
        step=1,
        schedule=cast("Any", None),
        scene=cast("Any", None),
        states={},
        rng=np.random.default_rng(0),
        gradients=gradients,
        losses=np.ones(views),
        labels=tuple(("near", "far")[k % 2] for k in range(views)),
        distances=np.linspace(0.5, 2.0, views),
        reference_distance=1.0,
        blocks=BLOCKS,
    )


def _arithmetic(operator: Operator, views: int) -> float | None:
    """Return the microseconds of `transform` for six blocks; None for other operators."""
    if not isinstance(operator, MatrixOperator):
        return None
    context = _context(_apart(_gradients(views, 6_000)))
    gramians = context.gradients.gramians("block")
    given = operator_context(context, "block", context.gradients.present("block"))
    rng = np.random.default_rng(0)
    state = EMPTY_STATE

    def step() -> None:
        nonlocal state
        _, state = operator.transform(gramians, given, state, rng)

    return round(1e6 * _least({"transform": step}, 200)["transform"], 1)


if __name__ == "__main__":
    main()
