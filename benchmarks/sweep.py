"""Measure the throughput of a sweep with several workers, relative to runs in sequence.

    python benchmarks/sweep.py [SCENE] [--runs 6] [--steps 400] [--max-size 400] [--workers 2]

The program times three sweeps of the same runs. The first uses one thread, in sequence. The second
uses one thread per worker, in sequence. The third uses all workers at the same time, with one
thread each. For comparison, it also times the same number of simultaneous `crossgrad run`
processes, and a single process. The results are only meaningful on a machine without other work.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml
from _machine import code, facts

from crossgrad_plugins.sweep.run_status import read_records

CROSSGRAD = [sys.executable, "-m", "crossgrad_core"]


def call(command: list[str]) -> None:
    """Run a command. If the command fails, exit with its output."""
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")


def swept(grid: Path, out: Path, workers: int, threads: int) -> float:
    """Return the seconds from the start of a sweep's first run to the end of its last run."""
    command = [*CROSSGRAD, "sweep", str(grid), "--out", str(out)]
    command += ["--workers", str(workers), "--threads", str(threads)]
    call(command)
    times = [each.when for each in read_records(out / "workers")]
    return (max(times) - min(times)).total_seconds()


def by_hand(arguments: argparse.Namespace, folder: Path, count: int) -> float:
    """Return the seconds of `count` simultaneous runs, each with one thread."""
    start = time.monotonic()
    runs = [subprocess.Popen(
        [*CROSSGRAD, "run", str(arguments.scene), "--steps", str(arguments.steps), "--threads", "1",
         "--max-size", str(arguments.max_size), "--seed", str(number), "-q",
         "--out", str(folder / f"{count}-{number}")],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) for number in range(count)]  # fmt: skip
    for run in runs:
        if run.wait():
            raise SystemExit("a run failed; start it with `crossgrad run` to see the reason")
    return time.monotonic() - start


def measured(arguments: argparse.Namespace, folder: Path) -> None:
    """Time all variants in a folder and print the ratios."""
    grid = folder / "grid.yaml"
    settings = {"steps": arguments.steps, "max_size": arguments.max_size}
    seeds = list(range(arguments.runs))
    grid.write_text(
        yaml.safe_dump(
            {"base": settings, "scenes": [str(arguments.scene.resolve())], "seeds": seeds}
        ),
        encoding="utf-8",
    )
    workers = arguments.workers
    for threads in (1, workers):  # Compile the kernels before the measurements.
        command = [*CROSSGRAD, "run", str(arguments.scene), "--steps", "20", "-q"]
        command += ["--threads", str(threads), "--out", str(folder / f"warm-{threads}")]
        call(command)
    one, many = by_hand(arguments, folder, 1), by_hand(arguments, folder, workers)
    print(f"{workers} runs at once, started by hand: {workers * one / many:.2f} x one", flush=True)
    together = swept(grid, folder / "together", workers, 1)
    for threads in (1, workers):
        alone = swept(grid, folder / f"alone-{threads}", 1, threads)
        print(
            f"sweep of {arguments.runs} runs, {workers} workers of one thread: {together:.1f} s, "
            f"{alone / together:.2f} x one after another with {threads} ({alone:.1f} s)",
            flush=True,
        )
    print(json.dumps({**facts(), "code": code(), "steps": arguments.steps}))


def main() -> None:
    """Read the options and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    bundled = Path(__file__).parents[1] / "examples" / "scenes" / "boruszyn"
    parser.add_argument("scene", type=Path, nargs="?", default=bundled)
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--max-size", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measured(arguments, Path(folder))


if __name__ == "__main__":
    main()
