"""Whether the state of a plugin stays bounded.

Its size may depend on the numbers of views and primitives, and on a window of the last steps. A
state that grows with every step makes each checkpoint larger than the one before.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.testing.contract import require

#: Steps of the first look, which is enough for a state that does not grow.
_FEW = 16
#: Length of each of the three further windows: states with a shorter memory stop growing there.
_WINDOW = 1000


def size_of(state: PluginState) -> int:
    """How many numbers, letters and names a state holds; rows of primitives count by columns."""
    rows = sum(tensor[:1].numel() for tensor in state.per_primitive.values())
    return _size(state.values) + sum(each.numel() for each in state.tensors.values()) + rows


def _size(value: object) -> int:
    if isinstance(value, str):
        return len(value)
    if isinstance(value, Mapping):
        return sum(_size(name) + _size(each) for name, each in value.items())
    if isinstance(value, list | tuple):
        return sum(map(_size, value))
    return 1


def require_bounded(sizes: Iterable[int], method: str) -> None:
    """Requires that the state of a run stops growing.

    Args:
        sizes: Size of the state after each step of a long run, measured as it is asked for.
        method: Name of the method that returns the state.
    """
    steps = iter(sizes)
    first, second = _largest(steps, _FEW // 2), _largest(steps, _FEW // 2)
    if second <= first:
        return
    later = [_largest(steps, _WINDOW) for _ in range(3)]
    require(
        not later[0] < later[1] < later[2],
        f"the state that {method} returns grows for ever: it holds {later[0]:,} numbers after "
        f"{_FEW + _WINDOW:,} steps and {later[2]:,} after {_FEW + 3 * _WINDOW:,}; expected a size "
        "that does not depend on the number of steps: keep sums, or a window of the last steps",
    )


def _largest(sizes: Iterator[int], steps: int) -> int:
    return max(islice(sizes, steps))
