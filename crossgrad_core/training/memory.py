"""Memory: the peak use, and the number of further primitives that fit."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from crossgrad_core.contract.contexts import ViewRecord

#: Number of copies of the parameters that always exist: the parameters and their two moments, once
#: in the state and once in the snapshot.
STANDING = 6
#: Number of additional copies of the parameters during an edit, when no autograd graph exists: the
#: new parameters and moments.
EDIT = 3
#: Memory of the autograd graph of one view until its backward pass ends, in units of the parameters
#: or of the decoded tensors of the view, whichever is larger. With the numba rasterizer, the
#: measured value is 2.7.
GRAPH = 3
#: Share of the available memory that growth may claim.
GROWTH_SHARE = 0.5


def peak_mebibytes(device: torch.device) -> float | None:
    """Return the peak memory of this process (resident set), or of the GPU, in MiB.

    None if the system does not report it.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def available_bytes(device: torch.device) -> int | None:
    """Return the bytes that can still be allocated; None if the system does not report them."""
    if device.type == "cuda":
        # Memory that torch has reserved does not count as free, but torch can use it for new
        # tensors.
        kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + kept
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


@dataclass(frozen=True)
class Demand:
    """Peak memory of a step for each primitive.

    Attributes:
        parameters: Bytes of the parameters.
        kept: Further bytes in the records of all views: decoded tensors and statistics.
        views: K.
        separate: True if the gradients of the views are stored separately.
        watched: True if the combined gradient must not overwrite the gradient of a view.
        joint: True if the graphs of all views exist at the same time.
        copies: Copies of the parameters in the states of rules.
    """

    parameters: int
    kept: int
    views: int
    separate: bool = False
    watched: bool = False
    joint: bool = False
    copies: int = 0

    @property
    def gradients(self) -> int:
        """Number of simultaneous gradients: one per view, or the sum and the newest gradient."""
        return self.views + self.watched if self.separate else min(self.views, 2)

    @property
    def bytes(self) -> int:
        """Bytes for each primitive."""
        graphs = self.views if self.joint else 1
        graph = GRAPH * graphs * max(self.parameters, self.kept // self.views)
        standing = STANDING + self.copies
        always = (standing + self.gradients) * self.parameters + self.kept
        return always + max(EDIT * self.parameters, graph)


def kept_bytes(records: Iterable[ViewRecord], parameters: Iterable[Tensor]) -> int:
    """Return the bytes of the tensors in the records of a step, without the parameters."""
    parameter_storages = {tensor.untyped_storage().data_ptr() for tensor in parameters}
    held: dict[int, int] = {}
    for record in records:
        for tensor in _tensors((*vars(record.gaussians).values(), *vars(record.screen).values())):
            storage = tensor.untyped_storage()
            held[storage.data_ptr()] = storage.nbytes()
    return sum(size for address, size in held.items() if address not in parameter_storages)


def _tensors(values: Iterable[object]) -> Iterable[Tensor]:
    return (value for value in values if isinstance(value, Tensor))


def room_for_primitives(device: torch.device, demand: Demand) -> int | None:
    """Return how many more primitives fit into the growth share of the available memory."""
    available = available_bytes(device)
    if available is None:
        return None
    return int(available * GROWTH_SHARE) // max(1, demand.bytes)
