"""Refuses a budget of CPU time that would not count work."""

import torch

from crossgrad_core.config import AUTO, RunConfig
from crossgrad_core.errors import UserError


def check_clock(config: RunConfig) -> None:
    """Refuses a budget in CPU seconds on several threads or a GPU; threads are set already.

    Raises:
        UserError: They would be counted while they wait, or not counted while they work.
    """
    if config.seconds is None or config.clock == "wall":
        return
    if config.device != AUTO and torch.device(config.device).type != "cpu":
        raise UserError(
            "CPU time does not tell what a GPU does",
            where="--clock cpu",
            expected="--device cpu",
            found=f"--device {config.device}",
            todo="leave --clock out",
        )
    threads = torch.get_num_threads()
    if threads > 1:
        raise UserError(
            "CPU time counts threads that wait for others, as they spin",
            where="--clock cpu",
            expected="one thread",
            found=f"{threads} threads",
            todo="add --threads 1, or leave --clock out",
        )
