"""Memory: how much was used, and how many more primitives the machine can take."""

import resource
import sys
from pathlib import Path

import torch

#: Copies of the parameters alive at the worst moment: parameter, gradient, two moments, the last
#: good state (three) and an edit under way (three).
COPIES = 10
#: Share of the available memory that growth may claim.
GROWTH_SHARE = 0.5


def peak_mebibytes(device: torch.device) -> float:
    """Peak memory of this process (resident set), or of the device where it is a GPU, MiB."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def available_bytes(device: torch.device) -> int | None:
    """Memory that can still be allocated; None where the system does not say."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    figures = [
        figure for figure in (_system_available(), _cgroup_available()) if figure is not None
    ]
    return min(figures) if figures else None


def _system_available() -> int | None:
    meminfo = Path("/proc/meminfo")
    if not meminfo.is_file():
        return None
    for line in meminfo.read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _cgroup_available() -> int | None:
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if not (limit.is_file() and used.is_file()):
        return None
    text = limit.read_text().strip()
    return None if text == "max" else max(0, int(text) - int(used.read_text()))


def room_for_primitives(device: torch.device, bytes_per_primitive: int) -> int | None:
    """How many more primitives fit into the growth share of the available memory."""
    available = available_bytes(device)
    if available is None:
        return None
    return int(available * GROWTH_SHARE) // max(1, COPIES * bytes_per_primitive)
