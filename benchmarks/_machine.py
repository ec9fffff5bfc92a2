"""Facts about the machine and the process, which every benchmark prints."""

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path


def facts() -> dict[str, str | int | float]:
    """Return facts about the machine, the time and the software of a measurement.

    Returns:
        ``cpu`` (model name), ``cores`` (usable by this process), ``threads`` (of numba), ``load``
        (1-minute load average at the call, or -1 if unavailable), ``date`` (UTC, ISO 8601) and the
        versions ``python``, ``torch``, ``numba`` and ``numpy``.
    """
    import numba

    return {
        "cpu": _cpu_model(),
        "cores": _cores(),
        "threads": numba.get_num_threads(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else -1.0,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numba": version("numba"),
        "numpy": version("numpy"),
    }


def code() -> str:
    """Return the commit (with a `+` if files are changed), or the version without a checkout."""
    root = Path(__file__).parents[1]
    try:
        head = _git(root, "rev-parse", "--short=7", "HEAD")
        return head + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return version("crossgrad")


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def peak_mib() -> float:
    """Return the peak resident memory of this process, MiB (NaN on Windows)."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # `ru_maxrss` is in KiB on Linux and in bytes on macOS.
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
