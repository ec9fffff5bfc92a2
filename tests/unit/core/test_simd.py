"""Vectors in kernels: what wide ones and triples hold, and that both widths compute the same."""

import numpy as np
import pytest

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    bits,
    broadcast_four,
    broadcast_four_wide,
    first_half,
    fma,
    halves_added,
    joined,
    last_half,
    load,
    load_fours,
    load_triples,
    load_wide,
    picking,
    splat,
    splat_wide,
    square_root,
    store,
    store_triples,
    where,
)

ORDER = [5, 31, 16, 0, 0, 7, 8, 30, 15, 17, 1, 2, 29, 3, 4, 6]
turned = picking(ORDER)


@kernel
def _turned(source, target):
    x, y, z = load_triples(source, 1)
    store_triples(target, 2, z, x, y)


@kernel
def _apart(source, target):
    for i, part in enumerate(load_fours(source, 1)):
        store(target, i * LANES, part)


@kernel
def _parts(source, target):
    store(target, 0, broadcast_four_wide(source, 3))
    store(target, WIDE, broadcast_four(source, 4))
    both = joined(load(source, LANES), load(source, 0))
    store(target, WIDE + LANES, both)
    store(target, 2 * WIDE + LANES, first_half(both))
    store(target, 3 * WIDE, last_half(both))
    store(target, 3 * WIDE + LANES, halves_added(load_wide(source, 0)))
    store(target, 4 * WIDE, turned(both, load_wide(source, 0)))


@kernel
def _eights(a, b, target):
    found = np.uint64(0)
    for i in range(0, WIDE, LANES):
        x, y = load(a, i), load(b, i)
        smaller = x < y
        root = square_root(fma(x, y, splat(np.float32(1.0))))
        store(target, i, where(smaller, root / y, x - y))
        found |= bits(smaller) << np.uint64(i)
    return found


@kernel
def _sixteen(a, b, target):
    x, y = load_wide(a, 0), load_wide(b, 0)
    smaller = x < y
    root = square_root(fma(x, y, splat_wide(np.float32(1.0))))
    store(target, 0, where(smaller, root / y, x - y))
    return bits(smaller)


def test_vectors_of_triples_are_split_and_joined_again():
    source = np.arange(3 * LANES + 1, dtype=np.float32)
    target = np.full(3 * LANES + 3, -1, np.float32)
    _turned(source, target)
    triples = source[1:].reshape(LANES, 3)
    np.testing.assert_array_equal(target[2:-1].reshape(LANES, 3), triples[:, [2, 0, 1]])
    assert target[[0, 1, -1]].tolist() == [-1, -1, -1]


def test_vectors_of_four_values_are_split():
    source = np.arange(4 * LANES + 1, dtype=np.float32)
    target = np.full(4 * LANES + 1, -1, np.float32)
    _apart(source, target)
    np.testing.assert_array_equal(target[:-1].reshape(4, LANES), source[1:].reshape(LANES, 4).T)
    assert target[-1] == -1


def test_vectors_can_be_split_into_parts():
    source = np.arange(WIDE, dtype=np.float32)
    target = np.empty(5 * WIDE, np.float32)
    _parts(source, target)
    first, second = range(LANES, WIDE), range(LANES)
    sums = [a + b for a, b in zip(first, second, strict=True)]
    expected = [*[3, 4, 5, 6] * 4, *[4, 5, 6, 7] * 2, *first, *second, *first, *second, *sums]
    both = [*first, *second, *range(WIDE)]
    assert target.tolist() == [*expected, *[both[place] for place in ORDER]]


@pytest.mark.parametrize("extreme", [0.0, 1e-40, 3e38, np.inf, np.nan])
def test_vectors_of_both_widths_give_the_same_bits(extreme):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, WIDE)).astype(np.float32)
    a[3] = b[12] = extreme
    eight, sixteen = np.empty(WIDE, np.float32), np.empty(WIDE, np.float32)
    assert _eights(a, b, eight) == _sixteen(a, b, sixteen)
    np.testing.assert_array_equal(eight.view(np.uint32), sixteen.view(np.uint32))
