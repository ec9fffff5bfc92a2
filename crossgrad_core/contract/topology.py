"""Topology edits: one mechanism that keeps parameters, moments and statistics aligned."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Block, Parameters, primitives_of
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
        return self.keeps_rows and not self.values and not self.counts

    @property
    def keeps_rows(self) -> bool:
        """Whether all primitives stay, and none begins afresh."""
        return self.source is None and self.fresh is None


#: The explicit answer of a densifier that changes nothing in this step.
NO_EDIT = Edit()


def misfit_of(edit: Edit, blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]) -> str:
    """What of an edit does not fit the parameters, in words; empty where all does."""
    before = primitives_of(blocks, parameters)
    if wrong := _no_set(edit, before):
        return wrong
    after = before if edit.source is None else len(edit.source)
    rows = {name for block in blocks if block.per_primitive for name in block.tensors}
    for name, new in edit.values.items():
        if name not in rows:
            return f"there is no tensor {name!r} with a row for each primitive"
        if wrong := _no_values(new, after, parameters[name].shape[1:]):
            return f"values of {name}: {wrong}"
    return ""


def _no_set(edit: Edit, before: int) -> str:
    """Why an edit of so many primitives gives no new set of them; empty where it does."""
    source, fresh = edit.source, edit.fresh
    if source is not None and (wrong := _no_list(source, torch.int64)):
        return f"source is {wrong}"
    after = before if source is None else len(source)
    if source is not None and after and not 0 <= int(source.min()) <= int(source.max()) < before:
        return f"source leaves 0 to {before - 1}"
    if fresh is not None and (wrong := _no_list(fresh, torch.bool)):
        return f"fresh is {wrong}"
    if fresh is not None and len(fresh) != after:
        return f"fresh has {len(fresh)} rows of {after}"
    return ""


def _no_list(found: object, dtype: torch.dtype) -> str:
    """What something is that should be a one-dimensional tensor of a type; empty where it is."""
    if not isinstance(found, Tensor):
        return f"of type {type(found).__module__}.{type(found).__name__}, not a tensor"
    good = found.ndim == 1 and found.dtype == dtype
    return "" if good else f"{list(found.shape)} of {found.dtype}, not [M] of {dtype}"


def _no_values(new: object, count: int, width: torch.Size) -> str:
    """Why something does not replace rows, of so many, of a width; empty where it does."""
    if not isinstance(new, Rows) or not isinstance(new.values, Tensor):
        return f"{type(new).__name__}, not Rows of a tensor"
    if new.rows is not None:
        if wrong := _no_list(new.rows, torch.int64):
            return f"rows are {wrong}"
        # On a GPU a look would be waited for.
        if new.rows.is_cpu and ((new.rows < 0) | (new.rows >= count)).any():
            return f"rows leave 0 to {count - 1}"
        count = len(new.rows)
    shape = (count, *width)
    return "" if _fits(new.values, shape) else f"{list(new.values.shape)}, not {list(shape)}"


def _fits(values: Tensor, shape: tuple[int, ...]) -> bool:
    """Whether values can be written to a tensor of a shape."""
    pairs = zip(reversed(values.shape), reversed(shape), strict=False)
    return values.ndim <= len(shape) and all(own in (1, size) for own, size in pairs)


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
    if edit.source is None:
        tensor = old.detach().clone()
    else:  # A plugin may list rows elsewhere than the parameters are.
        tensor = old.detach().index_select(0, edit.source.to(old.device))
    if overwrite is not None:
        rows = slice(None) if overwrite.rows is None else overwrite.rows
        tensor[rows] = overwrite.values.to(tensor.dtype)
    return tensor.requires_grad_(old.requires_grad)


def apply_to_moment(edit: Edit, name: str, old: Tensor) -> Tensor:
    """An optimizer moment of the per-primitive tensor `name` after an edit.

    Rows that are fresh, and rows overwritten without `keep_moments`, start at zero.
    """
    source, fresh = gather_indices(edit, old.shape[0], old.device)
    new = old if edit.keeps_rows else carried(old, source, fresh)
    overwrite = edit.values.get(name)
    if overwrite is not None and not overwrite.keep_moments:
        new = new.clone()
        new[slice(None) if overwrite.rows is None else overwrite.rows] = 0.0
    return new
