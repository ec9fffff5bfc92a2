"""Memory: how much was used, and how many more primitives the machine can take."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from crossgrad_core.contract.contexts import ViewRecord

#: Copies of the parameters that are always alive: themselves, two moments, the last good state.
STANDING = 6
#: ... and while an edit is under way, when no graph is left: the new parameters and moments.
EDIT = 3
#: What the graph of one view takes until its backward pass is over, in units of the parameters or,
#: where that is more, of what was decoded for the view. Measured with the numba rasterizer: 2.7.
GRAPH = 3
#: Share of the available memory that growth may claim.
GROWTH_SHARE = 0.5


def peak_mebibytes(device: torch.device) -> float | None:
    """Peak memory of this process (resident set), or of the device where it is a GPU, MiB.

    None where the system does not say.
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
    """Memory that can still be allocated; None where the system does not say."""
    if device.type == "cuda":
        # What torch holds on to for its next tensors is there for them, and not free.
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
    """Memory that a step keeps for each primitive, at the worst moment.

    Attributes:
        parameters: Bytes of its parameters.
        kept: Bytes that the records of all views hold besides: what was decoded, the statistics.
        views: K.
        separate: Whether the views' gradients are kept apart.
        watched: Whether their combination may not overwrite one of them.
        joint: Whether the graphs of all views are alive at once.
        copies: Copies of the parameters that the states of rules hold.
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
        """Gradients alive at once: all views', or the sum so far and that of the newest view."""
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
    """Bytes of what the records of a step hold besides the parameters themselves."""
    own = {tensor.untyped_storage().data_ptr() for tensor in parameters}
    held: dict[int, int] = {}
    for record in records:
        for tensor in _tensors((*vars(record.gaussians).values(), *vars(record.screen).values())):
            storage = tensor.untyped_storage()
            held[storage.data_ptr()] = storage.nbytes()
    return sum(size for place, size in held.items() if place not in own)


def _tensors(values: Iterable[object]) -> Iterable[Tensor]:
    return (value for value in values if isinstance(value, Tensor))


def room_for_primitives(device: torch.device, demand: Demand) -> int | None:
    """How many more primitives fit into the growth share of the available memory."""
    available = available_bytes(device)
    if available is None:
        return None
    return int(available * GROWTH_SHARE) // max(1, demand.bytes)
