"""The machine and the versions that a run was executed with."""

import os
import platform
import subprocess
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
        "commit": commit(),
        "python": platform.python_version(),
        "packages": packages,
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cpu_cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "device": device,
        "gpu": torch.cuda.get_device_name(device) if device.startswith("cuda") else None,
    }


def commit(package: Path = Path(__file__).parents[2]) -> str | None:
    """The commit of the checkout that the code comes from, with a `+` where files differ from it.

    None of an installed package, wherever that lies, and where there is no git.

    Args:
        package: Folder of the package `crossgrad_core`.
    """
    root = package.parent
    if not ((root / ".git").exists() and (root / "pyproject.toml").is_file()):
        return None
    try:
        head = _git(root, "rev-parse", "--short=7", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    # Without locks: a run only looks on while others may commit.
    command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=20)
    return done.stdout.strip()


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
