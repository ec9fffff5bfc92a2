"""Refusals as lines: exactly the refusals, in few lines."""

from itertools import product

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.refusals import every_combination, from_lines, refused

from crossgrad_plugins.authoring.matrix.combinations import as_lines

ROWS = list(product("abc", "de", "fgh", "ij", "kl"))
REASONS = ("needs K = 2 (--views); K is 1", "has no: tensors", "is late")


@settings(suppress_health_check=[HealthCheck.too_slow])  # A busy machine is slow enough.
@given(
    st.dictionaries(
        st.sampled_from(ROWS), st.sets(st.sampled_from(REASONS), min_size=1), max_size=len(ROWS)
    )
)
def test_lines_of_refusals_are_read_back_exactly(refusals):
    lines = as_lines(refusals, ROWS)
    assert {row: set(reasons) for row, reasons in from_lines(lines, ROWS).items()} == refusals
    assert lines == sorted(set(lines))


def test_a_reason_of_two_components_is_one_line_for_all_other_components():
    concerned = [row for row in ROWS if row[0] == "b" and row[3] == "i"]
    found = as_lines(dict.fromkeys(concerned, ("does not fit",)), ROWS)
    assert found == ["sampler=b densifier=i: does not fit"]
    concerned = [row for row in ROWS if row[1] == "d"]
    assert as_lines(dict.fromkeys(concerned, ("is off",)), ROWS) == ["operator=d: is off"]


def test_a_reason_for_all_combinations_names_no_component():
    assert as_lines(dict.fromkeys(ROWS, ("is off",)), ROWS) == [": is off"]
    assert set(from_lines([": is off"], ROWS)) == set(ROWS)


def test_all_reasons_of_a_refusal_are_listed_separately():
    row = ("three-way", "anchors", "vanilla", "anchor", "numba")
    assert row in every_combination()
    (reasons,) = refused([row]).values()
    assert len(reasons) == 2
    assert not refused([("random", "sum", "vanilla", "adc", "numba")])
