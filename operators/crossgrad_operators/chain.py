"""Operators in sequence: `a+b` on the command line."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GramianOperator,
    MatrixOperator,
    OperatorContext,
    PluginState,
    Selection,
    UserError,
    component_name,
    hookimpl,
    transformed,
)
from crossgrad_operators._nested import (
    OperatorField,
    first_grouping,
    inner_idle,
    inner_objections,
    inner_state,
    outer_state,
    reads_gramians,
)

#: A row of the matrix counts as rounding noise if its length is below this share of the length of
#: its terms.
_NOISE = 1e-14


class Chain(GramianOperator):
    """A sequence of operators. Each operator transforms the result of the previous operator.

    The matrix of the chain is the product of the matrices of its operators (links). The resulting
    rows are added. Each link receives only the K x K Gramian M G M^T, where M is the product of the
    earlier matrices. Without links, the chain equals `sum`.
    """

    links: tuple[OperatorField, ...] = Field(
        (), description="operators in the order in which they are applied"
    )

    @override
    def is_identity(self, views: int) -> bool:
        return views == 1 and all(link.is_identity(views) for link in self.links)

    @override
    def needs_more_views(self, views: int) -> bool:
        return any(link.needs_more_views(views) for link in self.links)

    @property
    @override
    def resolved_grouping(self) -> str | None:
        return first_grouping(self.links)

    @override
    def reads_gramians(self) -> bool:
        return reads_gramians(self.links)

    @override
    def reads_labels(self) -> bool:
        return any(link.reads_labels() for link in self.links)

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        return inner_idle(selection, "links", self.links)

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        blocks, views, _ = gramians.shape
        product = np.tile(np.eye(views), (blocks, 1, 1))
        seen, seen_context = gramians, context
        states = {}
        for position, link in enumerate(self.links):
            if seen.shape[1] != views:
                raise _reshaped(self.links[position - 1], seen.shape[1], views)
            key = str(position)
            inner = inner_state(state, key)
            matrices, states[key] = transformed(link, seen, seen_context, inner, rng)
            product = matrices @ product
            seen = product @ gramians @ product.swapaxes(1, 2)
            empty = _noise(seen, product, gramians)
            product = np.where(empty[:, :, None], 0.0, product)
            seen = np.where(empty[:, :, None] | empty[:, None, :], 0.0, seen)
            rounding_residuals = _remainders(product, gramians, context, seen)
            seen_context = replace(context, present=~empty, rounding_residuals=rounding_residuals)
        return product, outer_state(states)

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return the objections of all links."""
        return [reason for link in self.links for reason in inner_objections(selection, link)]


def _noise(
    seen: NDArray[np.float64], product: NDArray[np.float64], gramians: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return True for rows [B, R] of M G that are zero or only cancellation noise."""
    norms = np.sqrt(np.diagonal(gramians, axis1=1, axis2=2))
    terms = np.abs(product) @ norms[:, :, None]
    empty: NDArray[np.bool_] = np.diagonal(seen, axis1=1, axis2=2) <= _NOISE * terms[:, :, 0] ** 2
    return empty


def _remainders(
    product: NDArray[np.float64],
    gramians: NDArray[np.float64],
    context: OperatorContext,
    seen: NDArray[np.float64],
) -> Callable[[], NDArray[np.float64]] | None:
    """Return a function that computes the rounding residuals of M G M^T.

    Return None if the residuals of G are unknown.
    """
    whole = context.rounding_residuals
    if whole is None:
        return None

    def work_out() -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.linear import lost_between

        return lost_between(product, gramians, whole(), seen)

    return work_out


def _reshaped(link: MatrixOperator, rows: int, views: int) -> UserError:
    return UserError(
        f"operator {component_name(link)} must be the last operator of a chain",
        expected=f"one direction for each of the {views} views",
        found=str(rows),
        todo="move it to the end of the chain",
    )
