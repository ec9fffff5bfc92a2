"""Gramians and contexts that the tests of operators share."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import strategies as st

from crossgrad_core.contract.blocks import EMPTY_STATE
from crossgrad_core.contract.contexts import OperatorContext
from crossgrad_core.registry.entries import build


@dataclass
class Asked:
    """An operator's answer for one block of gradients."""

    weights: np.ndarray
    result: np.ndarray
    state: object


def context_of(gramians, labels=None, distances=None, blocks=None, losses=None):
    count, views, _ = gramians.shape
    return OperatorContext(
        step=1,
        blocks=blocks or tuple(f"b{i}" for i in range(count)),
        kinds=("geometry",) * count,
        losses=np.ones(views) if losses is None else np.asarray(losses, float),
        labels=labels or tuple(("near", "far")[k % 2] for k in range(views)),
        distances=np.ones(views) if distances is None else np.asarray(distances, float),
        reference_distance=1.0,
        present=np.einsum("bkk->bk", gramians) > 0,
    )


def ask(operator, rows, state=EMPTY_STATE, seed=0, **circumstances):
    """The weights and the direction for gradients `rows` [K, P]; options with a dict."""
    if isinstance(operator, str):
        operator = build("operators", operator, {})
    rows = np.asarray(rows, float)
    gramians = (rows @ rows.T)[None]
    context = context_of(gramians, **circumstances)
    rng = np.random.default_rng(seed)
    matrices, state = operator.transform(gramians, context, state, rng)
    weights = np.where(context.present, matrices.sum(axis=1), 0.0)[0]
    return Asked(weights, weights @ rows, state)


@pytest.fixture(name="ask")
def _ask():
    return ask


@pytest.fixture(name="context_of")
def _context_of():
    return context_of


@st.composite
def gradient_rows(draw, max_views=6):
    """K rows of any rank, some zero, repeated or opposite, norms from 1e-6 to 1e+6."""
    views = draw(st.integers(1, max_views))
    size = draw(st.integers(1, 6))
    entry = st.integers(-8, 8)
    rows = np.array(
        draw(
            st.lists(st.lists(entry, min_size=size, max_size=size), min_size=views, max_size=views)
        ),
        float,
    )
    powers = draw(st.lists(st.integers(-6, 6), min_size=views, max_size=views))
    rows = rows * 10.0 ** np.array(powers)[:, None]
    for k in range(1, views):
        match draw(st.sampled_from(("own", "own", "own", "zero", "repeated", "opposite"))):
            case "zero":
                rows[k] = 0.0
            case "repeated":
                rows[k] = rows[k - 1]
            case "opposite":
                rows[k] = -rows[k - 1]
    return rows


@pytest.fixture(name="gradient_rows")
def _gradient_rows():
    return gradient_rows
