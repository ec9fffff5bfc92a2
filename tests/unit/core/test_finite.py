"""Checks for finite and for non-zero tensors."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.gradients.finite import (
    all_finite_and_present,
    finite_and_present,
    is_finite,
)

#: Bits of float32: zeros of both signs, subnormal, largest, infinite and NaN ones among them.
BITS = st.one_of(
    st.sampled_from([0, 1 << 31, 1, 0x7F7FFFFF, 0x7F800000, 0xFF800000, 0x7FC00000, 0xFF800001]),
    st.integers(0, 2**32 - 1),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(BITS, max_size=40), st.sampled_from([torch.float32, torch.float64]))
def test_float_values_of_any_bits_are_classified_as_by_torch(bits, dtype):
    values = torch.from_numpy(np.array(bits, np.uint32).view(np.float32)).to(dtype)
    finite, present = finite_and_present(values)
    assert finite == bool(torch.isfinite(values).all())
    assert present == bool((values != 0).any())
    assert is_finite(values) == finite


@pytest.mark.parametrize("place", [0, 77, -1])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("rows", [511, 600])  # looked at by one thread, and by all
def test_one_bad_element_among_many_is_found(place, value, rows):
    values = torch.zeros(rows * 511)
    assert finite_and_present(values) == (True, False)
    values[place] = value
    assert finite_and_present(values) == (False, True)
    assert finite_and_present(values.view(rows, 511).T) == (False, True)


def test_missing_and_empty_tensors_count_as_finite_and_zero():
    assert finite_and_present(None) == (True, False)
    assert finite_and_present(torch.zeros(0, 3, requires_grad=True)) == (True, False)


@pytest.mark.parametrize("seed", range(30))
def test_checking_many_tensors_at_once_equals_checking_each_tensor(seed):
    """Use tensors of all kinds in any order, with sizes close to the size of a checked chunk."""
    rng = np.random.default_rng(seed)
    tensors = []
    for _ in range(rng.integers(0, 9)):
        size = int(rng.choice([0, 1, 3, 2**15 - 1, 2**15, 2**15 + 1, 300_000]))
        values = torch.zeros(size)
        if size and rng.random() < 0.7:
            values[int(rng.integers(size))] = float(rng.choice([1e-45, -1.0, np.inf, np.nan]))
        if rng.random() < 0.2:
            values = values.double()
        if rng.random() < 0.2:
            values = values.to_sparse()
        if size % 3 == 0 and not values.is_sparse and rng.random() < 0.3:
            values = values.view(-1, 3).T
        tensors.append(None if rng.random() < 0.1 else values)
    found = all_finite_and_present(tensors)
    for tensor, judged in zip(tensors, found, strict=True):
        dense = torch.zeros(0) if tensor is None else tensor.to_dense()
        assert judged == (bool(dense.isfinite().all()), bool((dense != 0).any()))
