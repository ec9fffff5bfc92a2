"""Topology edits: one mechanism that keeps parameters, moments and statistics aligned."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Block, Parameters
from crossgrad_core.contract.state import carried


@dataclass(frozen=True)
class Rows:
    """New values for some rows of a tensor.

    Attributes:
        rows: [R] int64 row indices *after* the edit; None means every row.
        values: [R, ...] values.
        keep_moments: Whether the optimizer's moments of these rows survive.
    """

    values: Tensor
    rows: Tensor | None = None
    keep_moments: bool = False


@dataclass(frozen=True)
class Edit:
    """A change of the set of primitives and of their values.

    New primitive j takes over every per-primitive row of old primitive `source[j]`: parameters,
    optimizer moments, statistics. That one gather expresses duplicate, split, relocate, remove and
    append; `fresh` marks rows that start with zero moments and statistics.

    Attributes:
        source: [M] int64 old index of each new primitive; None where the set stays as it is.
        fresh: [M] bool; None means that no row is fresh.
        values: Tensor name -> rows to overwrite after the gather.
        counts: What happened, for the log (`cloned`, `split`, `pruned`, `reset` ...).
    """

    source: Tensor | None = None
    fresh: Tensor | None = None
    values: Mapping[str, Rows] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether it changes nothing and counts nothing."""
        return self.source is None and not self.values and not self.counts


#: The explicit answer of a densifier that changes nothing in this step.
NO_EDIT = Edit()


def gather_indices(edit: Edit, primitives: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`source` [M] and `fresh` [M] of an edit with the defaults filled in."""
    source = edit.source
    if source is None:
        source = torch.arange(primitives, device=device)
    fresh = edit.fresh
    if fresh is None:
        fresh = torch.zeros(source.shape[0], dtype=torch.bool, device=device)
    return source, fresh


def apply_to_parameters(
    edit: Edit, blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]
) -> Parameters:
    """The parameters after an edit: new leaf tensors that require gradients where the old ones did.

    What an edit does not change is passed on as the same object.
    """
    new = dict(parameters)
    for block in blocks:
        if block.per_primitive:
            for name in block.tensors:
                new[name] = _edited(edit, name, parameters[name])
    return new


def _edited(edit: Edit, name: str, old: Tensor) -> Tensor:
    overwrite = edit.values.get(name)
    if edit.source is None and overwrite is None:
        return old
    tensor = old.detach()[edit.source] if edit.source is not None else old.detach().clone()
    if overwrite is not None:
        rows = slice(None) if overwrite.rows is None else overwrite.rows
        tensor[rows] = overwrite.values.to(tensor.dtype)
    return tensor.requires_grad_(old.requires_grad)


def apply_to_moment(edit: Edit, name: str, old: Tensor) -> Tensor:
    """An optimizer moment of the per-primitive tensor `name` after an edit.

    Rows that are fresh, and rows overwritten without `keep_moments`, start at zero.
    """
    source, fresh = gather_indices(edit, old.shape[0], old.device)
    new = carried(old, source, fresh) if edit.source is not None else old
    overwrite = edit.values.get(name)
    if overwrite is not None and not overwrite.keep_moments:
        new = new.clone()
        new[slice(None) if overwrite.rows is None else overwrite.rows] = 0.0
    return new
