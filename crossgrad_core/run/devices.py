"""The device of a run by its name."""

import torch

from crossgrad_core.errors import UserError


def choose_device(name: str) -> torch.device:
    """The torch device of that name.

    Raises:
        UserError: There is no such device on this machine.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(
            f"there is no device {name!r}",
            where="--device",
            expected="auto, cpu, cuda or cuda:N",
            todo="leave --device out to run on a GPU if one can be used, or use --device cpu",
        ) from error
    if device.type not in {"cpu", "cuda"}:
        raise UserError(
            f"device type {device.type!r} is not supported",
            where="--device",
            expected="cpu or cuda",
            todo="use --device cpu",
        )
    if device.type == "cuda":
        _require_cuda(device)
    return device


def _require_cuda(device: torch.device) -> None:
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) < count:
        return
    # A build of torch for AMD's GPUs calls them CUDA devices, too.
    built_for = torch.version.cuda or torch.version.hip
    if built_for is None:
        found, todo = "a build for CPUs only", "install a CUDA build of torch"
    elif count == 0:
        found = f"a build for CUDA {built_for}, but no GPU that it can use"
        todo = "run nvidia-smi: it tells whether there is a GPU and whether its driver works"
    else:
        found, todo = f"devices cuda:0 to cuda:{count - 1}", "choose one of them"
    raise UserError(
        f"torch sees no device {str(device)!r}",
        where="--device",
        found=f"torch {torch.__version__}: {found}",
        todo=f"use --device cpu, or {todo}",
    )
