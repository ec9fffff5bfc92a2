"""The machine and the versions that a run was executed with."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from crossgrad_core.contract.state import Json
from crossgrad_core.system.version import VERSION

_PACKAGES = ("torch", "numba", "numpy", "scipy", "scikit-image", "pycolmap", "pluggy", "pydantic")


def environment(device: str = "cpu") -> dict[str, Json]:
    """Machine, device, threads and versions as plain data; needs no package to be imported first.

    Args:
        device: Torch device that the run used.
    """
    import torch

    packages: dict[str, Json] = {name: _version(name) for name in _PACKAGES}
    return {
        "crossgrad": VERSION,
        "python": platform.python_version(),
        "packages": packages,
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cpu_cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "device": device,
        "gpu": torch.cuda.get_device_name(device) if device.startswith("cuda") else None,
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
