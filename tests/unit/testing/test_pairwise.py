"""Pairwise designs: complete, small, the same each time."""

from itertools import combinations, product

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.pairwise import pairs_of, pairwise

from crossgrad_plugins.authoring.matrix.combinations import meetings


def pairs(rows):
    return {(i, j, row[i], row[j]) for row in rows for i, j in combinations(range(len(rows[0])), 2)}


@settings(suppress_health_check=[HealthCheck.too_slow])  # A busy machine is slow enough.
@given(st.sets(st.tuples(*[st.sampled_from("abcd")] * 4), min_size=1))
def test_a_pairwise_design_contains_every_possible_pair_and_no_redundant_row(admitted):
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
def test_pairwise_designs_are_far_smaller_than_the_full_product(sizes, most):
    rows = list(product(*(list("abcdefghijklmnopqrstuvwxyz"[:n]) for n in sizes)))
    chosen = pairwise(rows)
    largest, second = sorted(sizes)[-2:][::-1]
    assert largest * second <= len(chosen) <= most
    assert chosen == pairwise(rows)


def test_pairs_contain_the_index_of_their_factors():
    assert pairs_of(("x", "x", "y")) == [(0, 1, "x", "x"), (0, 2, "x", "y"), (1, 2, "x", "y")]


def test_an_empty_product_has_an_empty_pairwise_design():
    assert pairwise([]) == []


VALUES = (("a", "b", "c"), ("k", "l"), ("x", "y", "z", "w"))
USUAL = ("a", "k", "x")


def completed(given):
    return tuple(given.get(i, value) for i, value in enumerate(USUAL))


def test_a_value_meets_all_other_values_in_the_fewest_rows():
    rows = list(meetings(0, "b", VALUES, completed, lambda _: True))
    assert len(rows) == 4
    assert all(row[0] == "b" for row in rows)
    assert {value for row in rows for value in enumerate(row)} >= {(1, "l"), (2, "w"), (2, "z")}


def test_a_refused_pair_is_tried_with_default_values_and_one_change():
    def admits(row):
        return not (row[2] == "w" and row[1] != "k")

    rows = list(meetings(0, "c", VALUES, completed, admits))
    assert ("c", "k", "w") in rows
    assert all(map(admits, rows))


def test_a_pair_that_is_always_refused_is_left_out():
    rows = list(meetings(0, "b", VALUES, completed, lambda row: row[2] != "z"))
    assert not [row for row in rows if row[2] == "z"]
    assert {row[2] for row in rows} == {"x", "y", "w"}
