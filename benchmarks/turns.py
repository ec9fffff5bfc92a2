"""Time the step of `step.py` in two checkouts, or with two threads and in two processes.

    python benchmarks/turns.py CASE.npz --beside CHECKOUT [--threads N] [--rounds N]
    python benchmarks/turns.py CASE.npz [--rounds N]

Shared machines change their speed within seconds, so two measurements one after the other could not
be compared. Here, the two measured variants are in memory all the time, and only one of them takes
a step at a time. With `--beside`, the variants are this checkout and an older checkout with an
environment from `make install`. Without `--beside`, the variants are one process with two threads,
and two simultaneous processes with one thread each on separate cores. The output is one JSON line:
medians of the seconds, and median and quartiles of the quotients over the rounds. The quotient is
this checkout's seconds divided by the other checkout's seconds, or the step rate of two threads
divided by the step rate of two processes.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter
from typing import Any

from _machine import code, facts

HERE = Path(__file__).parents[1]
#: Number of steps before the measurement.
WARM_UP = 4


class Worker:
    """A process that takes a step of a checkout on request.

    Args:
        checkout: Folder of the checkout.
        case: The case file.
        threads: Number of threads of the step.
        core: Core on which the process runs; None for any core.
    """

    def __init__(self, checkout: Path, case: Path, threads: int, core: int | None = None) -> None:
        own = sys.executable if checkout == HERE else str(checkout / ".venv/bin/python")
        environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
        environment |= {"NUMBA_NUM_THREADS": "1"} if threads == 1 else {}
        command = [own, __file__, str(case), "--worker", str(checkout), "--threads", str(threads)]
        self._process = subprocess.Popen(
            command if core is None else ["taskset", "--cpu-list", str(core), *command],
            cwd=checkout,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ask()
        self.seconds()

    def ask(self) -> None:
        """Request a step, and return at once."""
        print(file=self._process.stdin, flush=True)

    def seconds(self) -> float:
        """Wait for the requested step, and return its seconds."""
        return float(self._process.stdout.readline())  # type: ignore[union-attr]

    def step(self) -> float:
        """Take a step, wait for it, and return its seconds."""
        self.ask()
        return self.seconds()

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def work(checkout: Path, case: Path, threads: int) -> None:
    """Take a step for each line of the standard input, and print its seconds."""
    sys.path[0] = str(checkout / "benchmarks")
    import numpy as np
    import step as steps
    import torch

    from crossgrad_core.numerics.threads import configure_threads

    configure_threads(threads)
    with np.load(case) as file:
        arrays = dict(file)
    if hasattr(steps, "Trainer"):
        trainer = steps.Trainer(arrays, 0.999)
        views = [steps.camera_of(arrays, degrees) for degrees in (30.0, 0.0)]
    else:
        trainer, views = Plain(steps, arrays), [steps.camera_of(arrays)] * 2
    shape = (views[0].height, views[0].width, 3)
    photo = torch.from_numpy(np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8))
    for _ in sys.stdin:
        for view in views:
            start = perf_counter()
            for _ in trainer.step(view, photo, rests=False):
                pass
        print(perf_counter() - start, flush=True)


class Plain:
    """The step of commits up to e216204, whose benchmark is a single function."""

    def __init__(self, steps: Any, case: dict[str, Any]) -> None:  # noqa: ANN401 - a module of another checkout
        self.steps, self.parameters = steps, steps.parameters_of(case)
        self.backbone, self.state = steps.Vanilla(), steps.AdamState()
        self.rasterizer = steps.NumbaRasterizer(max_alpha=0.999, near=0.01)
        schedule = steps.Schedule.for_run(30_000)
        self.phase = steps.Phase(steps.STEP, training=True, schedule=schedule)
        self.rates = dict.fromkeys(self.parameters, 0.0)

    def step(self, camera: Any, photo: Any, *, rests: bool) -> list[str]:  # noqa: ANN401 - see above
        """Take a step."""
        gaussians = self.backbone.decode(self.parameters, camera, self.phase)
        image = self.rasterizer.render(gaussians, camera, self.steps.torch.zeros(3)).image
        self.steps.photometric_loss(image, photo).backward()
        gradients = {name: tensor.grad for name, tensor in self.parameters.items()}
        self.steps.adam_step(self.parameters, gradients, self.state, self.rates)
        for tensor in self.parameters.values():
            tensor.grad = None
        return []


def beside(case: Path, other: Path, threads: int, rounds: int) -> dict[str, Any]:
    """Return the times of alternating steps of this checkout and of the other checkout."""
    core = 0 if threads == 1 else None
    workers = [Worker(HERE, case, threads, core), Worker(other, case, threads, core)]
    seconds: list[list[float]] = [[], []]
    for turn in range(WARM_UP + rounds):
        # The two checkouts alternate in taking the first step of a round.
        for side in (0, 1) if turn % 2 else (1, 0):
            took = workers[side].step()
            if turn >= WARM_UP:
                seconds[side].append(took)
    for worker in workers:
        worker.end()
    quotients = [own / others for own, others in zip(*seconds, strict=True)]
    return {
        "seconds": median(seconds[0]),
        "beside": median(seconds[1]),
        "threads": threads,
        **_spread(quotients),
    }


def two_ways(case: Path, rounds: int) -> dict[str, Any]:
    """Return the times of two threads in one process, and of two simultaneous processes."""
    both = Worker(HERE, case, 2)
    apart = [Worker(HERE, case, 1, core) for core in (0, 1)]
    together, alone = [], []
    for turn in range(WARM_UP + rounds):
        took = median([both.step() for _ in range(3)])
        pairs = []
        for _ in range(3):
            for worker in apart:
                worker.ask()
            pairs.append([worker.seconds() for worker in apart])
        rates = sum(1 / median(times) for times in zip(*pairs, strict=True))
        if turn >= WARM_UP:
            together.append(took)
            alone.append(1 / rates)
    for worker in (both, *apart):
        worker.end()
    quotients = [pair / one for one, pair in zip(together, alone, strict=True)]
    return {
        "two_threads": median(together),
        "two_processes": median(alone),
        **_spread(quotients),
    }


def _spread(quotients: list[float]) -> dict[str, float]:
    low, _, high = quantiles(quotients, n=4)
    return {"quotient": median(quotients), "low": low, "high": high}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--beside", type=Path, metavar="CHECKOUT")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=80)
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    case, other = arguments.case.resolve(), arguments.beside
    if arguments.worker is not None:
        work(arguments.worker, case, arguments.threads)
        return
    if other is None:
        found = two_ways(case, arguments.rounds)
    else:
        found = beside(case, other.resolve(), arguments.threads, arguments.rounds)
    about = {"rounds": arguments.rounds, "commit": code(), **facts()}
    print(json.dumps({"benchmark": "turns", "case": case.name, **about, **found}))


if __name__ == "__main__":
    main()
