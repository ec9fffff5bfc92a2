"""Stored test cases, and mutations of stored cases."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from crossgrad_core.plugin import ViewCounts
from crossgrad_operators.stress.search.families import (
    ELEMENTS,
    VIEWS,
    Batch,
    Rows,
    cases_of,
    rounded,
)


@dataclass(frozen=True, eq=False)
class Sample:
    """A case with a value that measures how bad the case is.

    Attributes:
        rows: [K, P] gradients, exactly represented in their type.
        dtype: Type of the gradients.
        family: Name of the family of gradients.
        turn: Number of the round in which the case was found.
        value: An error, or the length of a result relative to the longest gradient.
    """

    rows: Rows
    dtype: torch.dtype
    family: str
    turn: int
    value: float

    @property
    def precision(self) -> str:
        """The name of the gradients' type."""
        return str(self.dtype).removeprefix("torch.")

    def text(self) -> str:
        """Return the rows as text, with enough digits to read the rows again exactly."""
        number = np.float32 if self.dtype == torch.float32 else np.float64
        rows = [[_shortest(number(value)) for value in row] for row in self.rows]
        return "[" + ",".join("[" + ",".join(row) + "]" for row in rows) + "]"


def _shortest(value: np.floating) -> str:
    text = np.format_float_scientific(value, trim="-", exp_digits=1)
    plain = repr(float(value)).removesuffix(".0")
    return min(text, plain, key=len) if float(plain) == float(text) else text


#: Suffix of the names of families that contain mutants.
MUTATED = ", mutated"

#: Function from (generator, gradients [B, K, P]) to changed gradients [B, K, P].
Mutation = Callable[[np.random.Generator, Rows], Rows]


def mutants(rng: np.random.Generator, parents: Sequence[Sample], admitted: ViewCounts) -> Batch:
    """Return a batch of variants of one of the parents.

    Sometimes, the variants have one row or element more or less.
    """
    parent = parents[int(rng.integers(len(parents)))]
    rows = parent.rows
    if rng.random() < 0.2:  # noqa: PLR2004
        reshaped = SHAPES[int(rng.integers(len(SHAPES)))](rng, rows)
        rows = reshaped if admitted.admits(len(reshaped)) else rows
    batch = np.repeat(rows[None], cases_of(len(rows)), axis=0)
    pieces = np.array_split(batch, len(MUTATIONS))
    # The order of the mutations is random, because a small batch has fewer cases than there are
    # mutations.
    order = rng.permutation(len(MUTATIONS)).tolist()
    variants = [
        MUTATIONS[mutation](rng, piece) for mutation, piece in zip(order, pieces, strict=True)
    ]
    result = rounded(np.nan_to_num(np.concatenate(variants)), parent.dtype)
    return Batch(result, parent.dtype, parent.family.removesuffix(MUTATED) + MUTATED)


def _nudge_elements(rng: np.random.Generator, rows: Rows) -> Rows:
    """Change some elements by relative amounts between 1 and 1e-16."""
    amount = 10.0 ** rng.uniform(-16, 0, (len(rows), 1, 1))
    chosen = rng.random(rows.shape) < rng.uniform(0, 1, (len(rows), 1, 1)) ** 2
    return np.asarray(rows * (1 + chosen * amount * rng.standard_normal(rows.shape)))


def _scale_rows(rng: np.random.Generator, rows: Rows) -> Rows:
    """Multiply some rows by factors between 1e-6 and 1e6."""
    chosen = rng.random((*rows.shape[:2], 1)) < 0.3  # noqa: PLR2004
    return np.asarray(rows * np.where(chosen, 10.0 ** rng.uniform(-6, 6, chosen.shape), 1.0))


def _approach(rng: np.random.Generator, rows: Rows) -> Rows:
    """Replace a row by plus or minus another row, plus a small share of the old row."""
    blocks, views, _ = rows.shape
    one, other = rng.integers(views, size=(2, blocks))
    every_block = np.arange(blocks)
    sign = rng.choice([-1.0, 1.0], (blocks, 1))
    share = 10.0 ** rng.uniform(-16, 0, (blocks, 1))
    result = rows.copy()
    result[every_block, one] = sign * rows[every_block, other] + share * rows[every_block, one]
    return result


def _replace_elements(rng: np.random.Generator, rows: Rows) -> Rows:
    """Replace some elements by zeros or by normally distributed numbers."""
    chosen = rng.random(rows.shape) < rng.uniform(0, 0.3, (len(rows), 1, 1))
    size = np.abs(rows).max(axis=2, keepdims=True)
    fresh = size * rng.standard_normal(rows.shape) * (rng.random(rows.shape) < 0.5)  # noqa: PLR2004
    return np.where(chosen, fresh, rows)


def _turn_rows(rng: np.random.Generator, rows: Rows) -> Rows:
    """Change the signs and the order of rows."""
    signs = np.where(rng.random((*rows.shape[:2], 1)) < 0.2, -1.0, 1.0)  # noqa: PLR2004
    order = rng.permuted(np.tile(np.arange(rows.shape[1]), (len(rows), 1)), axis=1)
    return np.asarray(np.take_along_axis(rows * signs, order[:, :, None], axis=1))


#: Function from (generator, gradients [K, P]) to gradients with one row or one column more or less.
Reshaping = Callable[[np.random.Generator, Rows], Rows]


def _fewer_rows(rng: np.random.Generator, rows: Rows) -> Rows:
    if len(rows) <= 2:  # noqa: PLR2004
        return rows
    return np.delete(rows, int(rng.integers(len(rows))), axis=0)


def _more_rows(rng: np.random.Generator, rows: Rows) -> Rows:
    if len(rows) >= VIEWS:
        return rows
    return np.concatenate([rows, rows[rng.integers(len(rows), size=1)]])


def _fewer_elements(rng: np.random.Generator, rows: Rows) -> Rows:
    if rows.shape[1] <= 1:
        return rows
    return np.delete(rows, int(rng.integers(rows.shape[1])), axis=1)


def _more_elements(rng: np.random.Generator, rows: Rows) -> Rows:
    if rows.shape[1] >= ELEMENTS:
        return rows
    size = np.abs(rows).max(axis=1, keepdims=True)
    return np.concatenate([rows, size * rng.standard_normal((len(rows), 1))], axis=1)


MUTATIONS: tuple[Mutation, ...] = (
    _nudge_elements,
    _scale_rows,
    _approach,
    _replace_elements,
    _turn_rows,
)
SHAPES: tuple[Reshaping, ...] = (_fewer_rows, _more_rows, _fewer_elements, _more_elements)
