"""The load of the machine while a run trained, and the speed of the machine."""

import os
import platform
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.system.version import VERSION

#: Seconds between two readings of the load.
LOOK_SECONDS = 1.0
#: Duration of a calibration in seconds.
CALIBRATION_SECONDS = 2.0
#: Shortest training time of a run with a calibration, in seconds. In shorter runs, the calibration
#: would take too large a part of the time.
WORTH_A_CALIBRATION = 20.0
#: Number of values in the calibration workload, and number of passes over the values between two
#: readings of the clock.
_NUMBERS, _PASSES = 1 << 16, 8


@dataclass(frozen=True)
class Calibration:
    """The speed of one CPU thread, measured with a fixed workload.

    Attributes:
        seconds: Duration of the calibration.
        rate: Passes over the workload per second of wall-clock time.
        cpu_rate: Passes over the workload per second of CPU time. Other processes have little
            effect on this number.
    """

    seconds: float
    rate: float
    cpu_rate: float


def calibrated(seconds: float = CALIBRATION_SECONDS) -> Calibration:
    """Measure the speed with products, exponentials and square roots of 65,536 float32 numbers."""
    numbers = np.linspace(0.0, 1.0, _NUMBERS, dtype=np.float32)
    room = np.empty_like(numbers)
    passes, start, cpu = 0, perf_counter(), thread_time()
    while perf_counter() - start < seconds:
        for _ in range(_PASSES):
            np.multiply(numbers, numbers, out=room)
            np.exp(room, out=room)
            np.sqrt(room, out=room)
        passes += _PASSES
    taken, cpu = perf_counter() - start, thread_time() - cpu
    return Calibration(round(taken, 3), round(passes / taken, 1), round(passes / cpu, 1))


class Machine:
    """A plugin that records the machine's load during the steps of a session."""

    def __init__(self) -> None:
        self._looked = 0.0
        self._loads: list[float] = []
        self._calibration: Calibration | None = None

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Record the load of the machine, at most once per second."""
        now = perf_counter()
        if now - self._looked >= LOOK_SECONDS and hasattr(os, "getloadavg"):
            self._looked = now
            self._loads.append(os.getloadavg()[0])

    def figures(self, train_seconds: float) -> dict[str, Json]:
        """Return the entries `load` and `calibration` for summary.json; null if unknown.

        Args:
            train_seconds: Training seconds of the run; a short run is not calibrated.
        """
        if self._calibration is None and train_seconds >= WORTH_A_CALIBRATION:
            self._calibration = calibrated()
        calibration = self._calibration
        loads = self._loads
        return {
            "load": {
                "mean": round(sum(loads) / len(loads), 2),
                "max": round(max(loads), 2),
            }
            if loads
            else None,
            "calibration": None if calibration is None else dict(vars(calibration)),
        }


_PACKAGES = ("torch", "numba", "numpy", "scipy", "scikit-image", "pycolmap", "pluggy", "pydantic")


def environment(device: str = "cpu") -> dict[str, Json]:
    """Return the machine, the device, the threads and the versions as plain data.

    This function imports no package except torch.

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
    """Return the git commit of the code, with a `+` if files differ from this commit.

    Return None for an installed package, or if git is not available.

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
    # Take no git locks, so that another process can commit at the same time.
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
