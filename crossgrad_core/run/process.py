"""Settings of the process, brought to those of a new one before training."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import numpy as np
import torch


@contextmanager
def as_in_a_command() -> Iterator[None]:
    """Inside the block torch and numpy are as in a new process; then as they were.

    Default type and device, `no_grad`, `inference_mode`, `np.errstate` and the number of threads
    would change the bits of a run, or end it.
    """
    threads = torch.get_num_threads(), numba.get_num_threads()
    kind, device = torch.get_default_dtype(), torch.get_default_device()
    torch.set_default_dtype(torch.float32)
    _set_device(device, torch.device("cpu"))
    try:
        with (
            torch.inference_mode(mode=False),
            torch.enable_grad(),
            np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"),
        ):
            yield
    finally:
        torch.set_default_dtype(kind)
        _set_device(torch.device("cpu"), device)
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


def _set_device(old: torch.device, new: torch.device) -> None:
    """Does nothing where there is nothing to do: a default device slows every call down."""
    if old != new:
        torch.set_default_device(new)
