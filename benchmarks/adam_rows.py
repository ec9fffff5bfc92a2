"""Time an Adam step of only the drawn rows, compared with a step of all rows.

    python benchmarks/adam_rows.py [--rows N] [--reps N]

Rows are drawn in random groups of 64 adjacent rows, because neighbouring Gaussians are adjacent in
Morton order. Each step has new groups. The deferred updates of these rows are done before the step.
The table shows both kinds of steps by the share of drawn rows. The constant `MOST_ROWS`
(crossgrad_core/training/adam/late.py) was chosen with this table.
"""

import argparse
import json
from statistics import median
from time import perf_counter

import numpy as np
import torch
from _machine import facts

from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.gradients.sparse_rows import sparse_rows
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.training.adam import late
from crossgrad_core.training.adam.adam import counted

#: Number of adjacent rows in a group, number of different selections, and shares of drawn rows.
RUN, CHOICES, SHARES = 64, 8, (0.1, 0.2, 0.3, 0.5, 0.7)


def milliseconds(count: int, share: float, most: float, reps: int) -> float:
    """Return the median milliseconds of a step with its deferred updates."""
    late.MOST_ROWS = most  # type: ignore[misc] - both ways are measured
    rng = np.random.default_rng(0)
    param, state, rows_late = torch.randn(count, 15, 3), AdamState(), late.Late()
    drawn = [
        np.flatnonzero(np.repeat(rng.random(count // RUN + 1) < share, RUN)[:count])
        for _ in range(CHOICES)
    ]
    rows = [torch.from_numpy(each) for each in drawn]
    values = [torch.randn(len(each), 15, 3) for each in rows]
    times = []
    for rep in range(CHOICES + reps):
        own = rep % CHOICES
        start = perf_counter()
        rows_late.catch_up("x", param, state, rows[own].to(torch.int32))
        step = counted("x", param, state, 1e-3, AdamRule(), 1.0)
        rows_late.step("x", param, sparse_rows(rows[own], values[own], param.shape), state, step)
        times.append(perf_counter() - start)
    return 1e3 * median(times[CHOICES:])


def main() -> None:
    """Print the table and the machine."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=112_000)
    parser.add_argument("--reps", type=int, default=32)
    given = parser.parse_args()
    configure_threads(1)
    print("| drawn | these rows, ms | all rows, ms |\n|---|---|---|")
    for share in SHARES:
        ways = (milliseconds(given.rows, share, most, given.reps) for most in (2.0, 0.0))
        print(f"| {share:.0%} | {' | '.join(f'{way:.1f}' for way in ways)} |")
    print(json.dumps(facts()))


if __name__ == "__main__":
    main()
