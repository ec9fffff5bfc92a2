"""Time a training step with several wait policies of threads, on idle and on busy cores.

    python benchmarks/busy.py CASE.npz [--rounds N] [--reps N] [--threads N]

Idle OpenMP threads wait in a loop for a while. This is fastest if no other program runs. Otherwise
the loop occupies a core that another program needs, or that the thread needs for which the loop
waits. Each round measures every policy twice: without other programs, and with one computing
program per core. The table shows medians over the rounds in ms. For comparison, the table also
shows a process with one thread, alone and together with a second such process. The reason is that
"two cores" may be one physical core.
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
#: Name of a policy -> environment variables of the process.
WAYS = {
    "crossgrad": {"OMP_WAIT_POLICY": "PASSIVE"},  # as crossgrad sets it
    "OpenMP's own": {},
    "spin 1,000": {"GOMP_SPINCOUNT": "1000"},
    "spin 10,000": {"GOMP_SPINCOUNT": "10000"},
    "spin 100,000": {"GOMP_SPINCOUNT": "100000"},
    "active": {"OMP_WAIT_POLICY": "ACTIVE"},
}
BUSY = "while True: pass"


@contextmanager
def beside(programs: int) -> Iterator[None]:
    """Run this number of computing programs during the `with` block."""
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
    """Return the median milliseconds of a step, averaged over simultaneous processes."""
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
    """Print the table."""
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
