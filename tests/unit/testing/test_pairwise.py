"""Pairwise designs: complete, small, the same each time."""

from itertools import combinations, product

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.pairwise import pairs_of, pairwise


def pairs(rows):
    return {(i, j, row[i], row[j]) for row in rows for i, j in combinations(range(len(rows[0])), 2)}


@given(st.sets(st.tuples(*[st.sampled_from("abcd")] * 4), min_size=1))
def test_every_pair_that_can_occur_occurs(admitted):
    chosen = pairwise(sorted(admitted))
    assert set(chosen) <= admitted
    assert pairs(chosen) == pairs(list(admitted))
    covered = set()
    for row in chosen:
        assert pairs([row]) - covered, "a row that was not needed when it was taken"
        covered |= pairs([row])


@pytest.mark.parametrize(
    ("sizes", "most"), [((9, 21, 7, 9), 220), ((3, 3, 3, 3), 12), ((2, 5), 10)]
)
def test_designs_are_far_smaller_than_the_product(sizes, most):
    rows = list(product(*(list("abcdefghijklmnopqrstuvwxyz"[:n]) for n in sizes)))
    chosen = pairwise(rows)
    largest, second = sorted(sizes)[-2:][::-1]
    assert largest * second <= len(chosen) <= most
    assert chosen == pairwise(rows)


def test_pairs_know_their_factors():
    assert pairs_of(("x", "x", "y")) == [(0, 1, "x", "x"), (0, 2, "x", "y"), (1, 2, "x", "y")]


def test_nothing_admitted_needs_no_case():
    assert pairwise([]) == []
