"""Measure the peak memory, and compute how many more primitives fit into the memory."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from crossgrad_core.contract.contexts import ViewRecord

#: Number of copies of the parameters that always exist: the parameters and their two moments, once
#: in the training state and once in the snapshot.
STANDING = 6
#: During an edit, the new parameters and their two moments also exist. No autograd graph exists
#: during an edit.
EDIT = 3
#: Memory of the autograd graph of one view until its backward pass ends. The unit is the memory of
#: the parameters or of the view's decoded tensors, whichever is larger. With the numba rasterizer,
#: the measured factor is 2.7.
GRAPH = 3
#: Largest share of the available memory that new primitives may use.
GROWTH_SHARE = 0.5


def peak_mebibytes(device: torch.device) -> float | None:
    """Return the peak memory of this process (resident set) or of the GPU, in MiB.

    Return None if the system does not report the peak memory.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    try:
        import resource
    except ImportError:  # Windows has no module `resource`.
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def available_bytes(device: torch.device) -> int | None:
    """Return the bytes that can still be allocated.

    Return None if the system does not report this number.
    """
    if device.type == "cuda":
        # On the GPU, memory that torch has reserved does not count as free. Torch can still use
        # this memory for new tensors.
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
    """The memory that a step needs for each primitive.

    Attributes:
        parameters: Bytes of the parameters of one primitive.
        kept: Bytes of decoded tensors and statistics that the records of all views store, for one
            primitive.
        views: Number of views K in the step.
        separate: True if the gradients of the views are stored separately.
        watched: True if the combined gradient must not overwrite the gradient of a view.
        joint: True if the autograd graphs of all views exist in parallel.
        copies: Number of copies of the parameters in the states of rules.
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
        """Number of gradients that exist in parallel.

        With separate gradients, one for each view; otherwise, the sum and the newest gradient.
        """
        return self.views + self.watched if self.separate else min(self.views, 2)

    @property
    def bytes(self) -> int:
        """Largest memory during a step for each primitive, in bytes."""
        graphs = self.views if self.joint else 1
        graph = GRAPH * graphs * max(self.parameters, self.kept // self.views)
        standing = STANDING + self.copies
        always = (standing + self.gradients) * self.parameters + self.kept
        return always + max(EDIT * self.parameters, graph)


def kept_bytes(records: Iterable[ViewRecord], parameters: Iterable[Tensor]) -> int:
    """Return the bytes of all tensors in the records of a step, except the parameters."""
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
    """Return how many more primitives may be added.

    New primitives may use the share `GROWTH_SHARE` of the available memory.
    """
    available = available_bytes(device)
    if available is None:
        return None
    return int(available * GROWTH_SHARE) // max(1, demand.bytes)
