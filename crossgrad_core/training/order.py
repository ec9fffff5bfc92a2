"""The order of primitives in memory: neighbours in space lie side by side.

What a camera sees is then a few long runs of rows rather than rows from everywhere, so that each
line of the processor's cache is used whole: a step costs less the more primitives are out of view.
Few primitives lie in the cache anyway and stay in the order that they come in.
"""

from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Block, Parameters
from crossgrad_core.contract.topology import Edit, Rows, apply_to_parameters

#: Primitives from which on they are put in order: of 59 parameters each and their moments, 12 MB.
FEWEST = 2**14
#: Bits of a coordinate in a code of 63 bits, and cells per unit of the local frame (of which the
#: cameras span about one): farther away than 128 units all is one cell.
_BITS = 21
_CELLS = 2**13
#: Shifts and masks that put two zeros between the bits of a number, from Morton's interleaving.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def along_curve(positions: Tensor) -> Tensor:
    """[N] int64: rows of `positions` [N, 3] (local frame) along Morton's curve; stable."""
    highest = 2**_BITS - 1
    cells = torch.nan_to_num(positions.detach().double() * _CELLS + 2 ** (_BITS - 1), nan=0.0)
    codes = cells.clamp(0, highest).long()
    for shift, mask in _SPREAD:
        codes = (codes | (codes << shift)) & mask
    return torch.argsort(codes[:, 0] | (codes[:, 1] << 1) | (codes[:, 2] << 2), stable=True)


def ordered(parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Parameters:
    """The parameters with their primitives along the curve, if there are many of them.

    Args:
        parameters: In any order.
        blocks: Of the backbone.
        name: The tensor that has the positions; without it the order stays as it is.
    """
    if not _placed(blocks, parameters, name) or len(parameters[name]) < FEWEST:
        return parameters
    rows = along_curve(parameters[name])
    return apply_to_parameters(Edit(source=rows), blocks, parameters)


def ordered_edit(edit: Edit, parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Edit:
    """The same edit with the new primitives along the curve, if there are many of them.

    Args:
        edit: One that changes the set of primitives.
        parameters: Those before the edit.
        blocks: Of the backbone.
        name: The tensor that has the positions; without it the edit stays as it is.
    """
    placed = _placed(blocks, parameters, name)
    if edit.source is None or not placed or len(edit.source) < FEWEST:
        return edit
    rows = along_curve(apply_to_parameters(edit, placed, parameters)[name])
    places = torch.empty_like(rows)
    places[rows] = torch.arange(len(rows), device=rows.device)
    return replace(
        edit,
        source=edit.source[rows],
        fresh=None if edit.fresh is None else edit.fresh[rows],
        values={name: _moved(each, rows, places) for name, each in edit.values.items()},
    )


def _placed(blocks: tuple[Block, ...], parameters: Parameters, name: str) -> tuple[Block, ...]:
    """The block whose tensor says where each primitive is, if there is one."""
    found = tuple(block for block in blocks if block.per_primitive and name in block.tensors)
    # A tensor of this name may be something else in a backbone of another kind.
    return found if found and parameters[name].shape[1:] == (3,) else ()


def _moved(values: Rows, rows: Tensor, places: Tensor) -> Rows:
    if values.rows is None:
        return replace(values, values=values.values[rows])
    return replace(values, rows=places[values.rows])
