"""Kernels of loss and optimizer, compiled by a process beside the one that compiles the others.

Numba compiles one kernel at a time in a process. A first start has as much to compile for what
comes behind the render as for the render itself, and finds it on disk when it gets there.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import torch

from crossgrad_core.config import ComponentChoice
from crossgrad_core.contract.adam_state import AdamRule, AdamState
from crossgrad_core.contract.loss import Loss
from crossgrad_core.gradients.sparse_rows import sparse_rows
from crossgrad_core.numerics.kernel_cache import told_of_missing
from crossgrad_core.registry.entries import build
from crossgrad_core.system.cores import available_cores
from crossgrad_core.training.adam.adam import adam_step, counted
from crossgrad_core.training.adam.axes import step_along_axes
from crossgrad_core.training.adam.late import Late
from crossgrad_core.training.setup import Setup

#: Seconds that the other process is waited for once this one has nothing left to compile.
_PATIENCE: Final = 60.0


@contextmanager
def compiling_beside(setup: Setup) -> Iterator[None]:
    """Starts the other process with the first kernel that is missing, and waits for it at last.

    Not where this one has one core, or one thread, to itself, and not for a GPU. At last, with or
    without that process, all kernels of steps by rows are in memory here: whether a view draws few
    rows or many, which have kernels of their own, is found out on the clock.
    """
    alone = setup.config.threads == 1 or available_cores() == 1
    processes: list[subprocess.Popen[bytes]] = []

    def start(*, kept: bool) -> None:
        if processes or alone or not kept or setup.device.type != "cpu":
            return
        command = [sys.executable, "-m", __name__, setup.config.loss.model_dump_json()]
        silent = subprocess.DEVNULL
        processes.append(subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent))

    try:
        with told_of_missing(start):
            yield
        for process in processes:
            # One that hangs, in a plugin's import perhaps, keeps no run from training.
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE)
        if setup.sparse_rows:
            compile_rows()
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def compile_all(loss: ComponentChoice) -> None:
    """Compiles what a loss and the optimizer need, on numbers that mean nothing."""
    photo = torch.zeros((64, 64, 3), dtype=torch.uint8)
    render = torch.full((64, 64, 3), 0.5, requires_grad=True)
    measured = build(Loss, loss.name, loss.options).loss(render, photo, None, None)
    measured.backward()  # type: ignore[no-untyped-call]
    values = torch.zeros((8, 3))
    adam_step({"all": values}, {"all": torch.ones_like(values)}, AdamState(), {"all": 1e-3})
    step_along_axes(values, values, values, torch.zeros((8, 4)))
    compile_rows()


def compile_rows() -> None:
    """Compiles what steps by rows need, likewise."""
    values, state, late = torch.zeros((8, 3)), AdamState(), Late()
    # One row of many, another one, which is late by then, and so many that all are taken.
    for rows in ([1], [4], [1, 4, 6]):
        grad = sparse_rows(torch.tensor(rows), torch.ones((len(rows), 3)), values.shape)
        late.step(
            "rows", values, grad, state, counted("rows", values, state, 1e-3, AdamRule(), 1.0)
        )
    late.finish()


if __name__ == "__main__":
    compile_all(ComponentChoice.model_validate(json.loads(sys.argv[1])))
