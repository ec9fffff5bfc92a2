"""State of plugins: values that are handed in, returned, checkpointed and carried through edits."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, TypeAlias

import torch
from torch import Tensor

#: Names of states that belong to the components of slots.
SLOTS: Final = frozenset({"densifier", "operator", "resolution", "sampler"})
#: These and the core's own: no other plugin may use them.
TAKEN: Final = SLOTS | {"average", "budget", "grouping", "photos", "thinned"}

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"


@dataclass(frozen=True)
class PluginState:
    """The state of one plugin between steps.

    Its size must not depend on the number of steps, because every checkpoint holds it: keep sums,
    or a window of at most 1,000 steps.

    Attributes:
        values: Plain numbers, strings, lists and dictionaries (must survive JSON).
        tensors: Tensors of any shape.
        per_primitive: Tensors whose first dimension is the number of primitives; topology edits
            gather their rows along with the parameters (rows of new primitives start at zero).
    """

    values: Mapping[str, Json] = field(default_factory=dict)
    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    per_primitive: Mapping[str, Tensor] = field(default_factory=dict)

    def __deepcopy__(self, memo: dict[int, Any]) -> "PluginState":
        # By hand, because the read-only mappings of `EMPTY_STATE` cannot be copied deeply.
        values = deepcopy(dict(self.values), memo)
        tensors, rows = (deepcopy(dict(part), memo) for part in (self.tensors, self.per_primitive))
        return PluginState(values, tensors, rows)

    def to(self, device: torch.device) -> "PluginState":
        """The state with its tensors on a device."""
        tensors, rows = (
            {name: tensor.to(device) for name, tensor in each.items()}
            for each in (self.tensors, self.per_primitive)
        )
        return PluginState(self.values, tensors, rows)

    def gathered(self, source: Tensor, fresh: Tensor) -> "PluginState":
        """The state after a topology edit.

        Args:
            source: [M] int64, for each new primitive the old one whose row it takes over.
            fresh: [M] bool, primitives whose rows start at zero.
        """
        rows = {name: carried(old, source, fresh) for name, old in self.per_primitive.items()}
        return PluginState(self.values, self.tensors, rows)


def carried(old: Tensor, source: Tensor, fresh: Tensor) -> Tensor:
    """Rows of `old` at `source` [M], with the rows marked in `fresh` [M] set to zero."""
    # A plugin may keep its numbers elsewhere than the run does.
    source, fresh = source.to(old.device), fresh.to(old.device)
    # Copies whole rows; to index with a tensor goes element by element.
    new = old.index_select(0, source)
    # On a GPU the number of the marked rows would be waited for.
    marked = fresh.nonzero()[:, 0] if fresh.is_cpu else fresh
    new[marked] = torch.zeros((), dtype=old.dtype, device=old.device)
    return new


#: The state of a plugin that has none yet; read-only, because all runs of a process share it.
EMPTY_STATE = PluginState(MappingProxyType({}), MappingProxyType({}), MappingProxyType({}))
