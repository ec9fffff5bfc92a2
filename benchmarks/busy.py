"""The cost of waiting threads: a training step with several ways to wait, alone and among others.

    python benchmarks/busy.py CASE.npz [--rounds N] [--reps N] [--threads N]

OpenMP's threads spin for a while when they have nothing to do, which is quickest where nothing else
runs, and takes the core from the process that needs it where something does: another program, or
the very thread that they wait for. In each round every way takes its turn, alone and beside as many
programs that compute as there are cores; the table has medians over the rounds in ms, and what one
process of one thread takes, alone and beside a second one, as "two cores" may be one.
"""

import argparse
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from _machine import code, facts

STEP = Path(__file__).with_name("step.py")
#: Name -> environment of a process.
WAYS = {
    "crossgrad": {"OMP_WAIT_POLICY": "PASSIVE"},  # as the command has it
    "OpenMP's own": {},
    "spin 1,000": {"GOMP_SPINCOUNT": "1000"},
    "spin 10,000": {"GOMP_SPINCOUNT": "10000"},
    "spin 100,000": {"GOMP_SPINCOUNT": "100000"},
    "active": {"OMP_WAIT_POLICY": "ACTIVE"},
}
BUSY = "while True: pass"


@contextmanager
def beside(programs: int) -> Iterator[None]:
    """So many programs compute meanwhile."""
    others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(programs)]
    try:
        yield
    finally:
        for each in others:
            each.kill()
            each.wait()


def step_ms(
    way: dict[str, str], arguments: argparse.Namespace, *, threads: int, processes: int = 1
) -> float:
    """Median milliseconds of a step, the mean over processes that run at the same time."""
    command = [sys.executable, str(STEP), str(arguments.case), "--reps", str(arguments.reps)]
    environment = {**os.environ, **way}
    running = [
        subprocess.Popen(
            [*command, "--threads", str(threads)], env=environment, stdout=subprocess.PIPE
        )
        for _ in range(processes)
    ]
    times = [json.loads(each.communicate()[0])["seconds"] for each in running]
    return 1e3 * sum(times) / len(times)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--reps", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = defaultdict(list)
    for _ in range(arguments.rounds):
        for name, way in WAYS.items():
            found[name, "quiet"].append(step_ms(way, arguments, threads=arguments.threads))
            with beside(cores or 1):
                found[name, "busy"].append(step_ms(way, arguments, threads=arguments.threads))
        found["one thread", "quiet"].append(step_ms({}, arguments, threads=1))
        two = step_ms({}, arguments, threads=1, processes=2)
        found["each of two", "quiet"].append(two)
    print(json.dumps({"code": code(), **facts()}))
    for (name, state), times in found.items():
        print(f"{name:14} {state:6} {median(times):7.1f} ms   {min(times):.1f} to {max(times):.1f}")


if __name__ == "__main__":
    main()
