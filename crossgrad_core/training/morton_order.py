"""The order of primitives in memory: neighbours in space lie side by side.

What a camera sees is then a few long runs of rows rather than rows from everywhere, so that each
line of the processor's cache is used whole: a step costs less the more primitives are out of view.
Few primitives lie in the cache anyway and stay in the order that they come in.
"""

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Block, Parameters
from crossgrad_core.contract.topology import Edit, apply_to_parameters

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


def in_order(parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Tensor | None:
    """[N] int64, the rows of the primitives along the curve; None where they stay as they are.

    Args:
        parameters: In any order.
        blocks: Of the backbone.
        name: The tensor that has the positions; without it the order stays as it is.
    """
    if not any(block.per_primitive and name in block.tensors for block in blocks):
        return None
    return along_curve(parameters[name]) if len(parameters[name]) >= FEWEST else None


def ordered(parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Parameters:
    """The parameters with their primitives in that order."""
    rows = in_order(parameters, blocks, name)
    return (
        parameters if rows is None else apply_to_parameters(Edit(source=rows), blocks, parameters)
    )
