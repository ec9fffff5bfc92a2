"""Gradients by rows: everything that is taken of them is what it is of dense ones, to the bit."""

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import Block, LearningRate
from crossgrad_core.gradients.finite import finite_and_present
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.sparse_rows import coalesced, dense, rows_of, sparse_rows
from crossgrad_core.gradients.summed import SummedGradients

ROWS = 900  # three chunks of the Gramians' kernel
RATE = LearningRate(1e-3)
BLOCKS = (
    Block("a", ("a",), True, "geometry", RATE),
    Block("b", ("b",), True, "appearance", RATE),
)
GRANULARITIES = ("block", "kind", "global", "gaussian")


def gradient(rng, share, shape):
    rows = np.flatnonzero(rng.random(ROWS) < share)
    values = rng.normal(size=(len(rows), *shape)).astype(np.float32)
    return sparse_rows(torch.from_numpy(rows), torch.from_numpy(values), (ROWS, *shape))


def drawn(seed, views):
    """K views' gradients; one view may not touch a tensor, one may touch no row of it."""
    rng = np.random.default_rng(seed)
    shares = rng.choice([0.0, 0.05, 0.5, 1.0], views)
    found = [
        {"a": torch.from_numpy(rng.normal(size=(ROWS, 3)).astype(np.float32)),
         "b": gradient(rng, share, (15, 3))}
        for share in shares
    ]  # fmt: skip
    if seed % 3 == 2:
        found[0]["b"] = None
    return found


def as_dense(views):
    return [{name: dense(g) for name, g in view.items()} for view in views]


def copied(views):
    return [{n: None if g is None else g.clone() for n, g in view.items()} for view in views]


def same(one, other):
    assert one.keys() == other.keys()
    for name, gradient in one.items():
        there = other[name]
        assert (gradient is None) == (there is None)
        assert gradient is None or torch.equal(dense(gradient), there)


@pytest.mark.parametrize(
    "rows", [[], [4], [0, 2, 7], [7, 2, 0], [1, 1, 3], [3, 1, 1]], ids=lambda rows: f"{rows}"
)
def test_rows_are_sorted_and_unique(rows):
    values = torch.arange(2.0 * len(rows)).view(len(rows), 2)
    found = coalesced(sparse_rows(torch.tensor(rows, dtype=torch.int64), values, (8, 2)))
    expected = torch.zeros(8, 2).index_add(0, torch.tensor(rows, dtype=torch.int64), values)
    assert rows_of(found).tolist() == sorted(set(rows))
    assert torch.equal(dense(found), expected)
    assert coalesced(found) is found


@pytest.mark.sampled(17)
@pytest.mark.parametrize("views", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_gramians_and_weighted_sums_have_the_bits_of_dense_gradients(seed, views, granularity):
    found = drawn(seed, views)
    ours = DenseGradients(copied(found), BLOCKS, overwrite=seed == 1)
    theirs = DenseGradients(as_dense(found), BLOCKS)
    assert ours.names(granularity) == theirs.names(granularity)
    gramians = theirs.gramians(granularity)
    assert np.array_equal(ours.gramians(granularity), gramians)
    assert np.array_equal(ours.present(granularity), theirs.present(granularity))
    assert np.array_equal(ours.overlap(granularity), theirs.overlap(granularity))
    weights = np.random.default_rng(seed).normal(size=gramians.shape[:2])
    same(ours.combine(weights, granularity), theirs.combine(weights, granularity))


@pytest.mark.parametrize("views", [2, 5])
def test_sums_and_dense_operations_have_the_bits_of_dense_gradients(views):
    found = drawn(1, views)
    for take in (
        lambda gradients: gradients.total(),
        lambda gradients: gradients.total(views),
        lambda gradients: gradients.elementwise(lambda _, g: torch.stack(list(g)).amax(dim=0)),
    ):
        same(
            take(DenseGradients(copied(found), BLOCKS)),
            take(DenseGradients(as_dense(found), BLOCKS)),
        )
    ours, theirs = (DenseGradients(each, BLOCKS) for each in (copied(found), as_dense(found)))
    assert np.array_equal(ours.rounding_residuals("block"), theirs.rounding_residuals("block"))
    assert np.array_equal(
        ours.rounding_residuals("gaussian"), theirs.rounding_residuals("gaussian")
    )


@pytest.mark.parametrize("views", [1, 2, 3])
@pytest.mark.parametrize("mixed", [False, True])
def test_running_sums_keep_sparse_rows_unless_a_view_is_dense(views, mixed):
    found = drawn(0, views)
    if mixed:
        found[-1]["b"] = dense(found[-1]["b"])
    plain = SummedGradients.empty(BLOCKS, views)
    for view in as_dense(found):
        plain.add({n: None if g is None else g.clone() for n, g in view.items()})
    ours = SummedGradients.empty(BLOCKS, views)
    for view in copied(found):
        ours.add(view)
    total = ours.total(views)
    assert total["b"].is_sparse == (not mixed)
    same(total, plain.total(views))
    assert np.array_equal(ours.present(), plain.present())


def test_a_sum_has_the_rows_of_all_its_views():
    rng = np.random.default_rng(0)
    views = [{"a": None, "b": gradient(rng, 0.01, (2,))} for _ in range(2)]
    union = sorted({row for view in views for row in rows_of(view["b"]).tolist()})
    total = DenseGradients(views, BLOCKS).total()["b"]
    assert rows_of(total).tolist() == union and len(union) < 40


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_view_that_is_not_finite_is_left_out(bad):
    found = drawn(0, 2)
    broken = sparse_rows(torch.tensor([4]), torch.full((1, 15, 3), bad), (ROWS, 15, 3))
    assert finite_and_present(broken) == (False, True)
    found[0]["b"] = broken
    same(DenseGradients(found, BLOCKS).total(), DenseGradients(as_dense(found), BLOCKS).total())
