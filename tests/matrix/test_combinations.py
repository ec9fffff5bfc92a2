"""Every combination runs, or is refused with a reason that is written down.

The normal run trains each component in at least two combinations. `make matrix` trains all
combinations, and repeats a pairwise design: every two components that can work together meet in
some case of it.
"""

from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from support.pairwise import pairs_of, pairwise
from support.refusals import every_combination, from_lines, refused

from crossgrad_core.errors import IncompatibleSelectionError
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import load
from crossgrad_core.testing.support.short_runs import (
    require_repeated,
    require_sound,
    setup_of,
    train,
)
from crossgrad_plugins.authoring.matrix.combinations import SLOTS, STEPS, as_lines, config_of

#: What operators count; everything else that a step counts is density control.
AGGREGATION = {"zero", "disjoint", "dropped", "conflict"}

WRITTEN = Path(__file__).with_name("refusals.txt").read_text().splitlines()
REFUSED = from_lines(WRITTEN, every_combination())
ADMITTED = [row for row in every_combination() if row not in REFUSED]
DESIGN = pairwise(ADMITTED)
DENSIFIERS = sorted({row[SLOTS.index("densifier")] for row in ADMITTED} - {"none"})


def pytest_generate_tests(metafunc):
    # Thousands of cases are not even collected where nobody asks for them.
    if "member" in metafunc.fixturenames:
        asked = metafunc.config.option.markexpr == "matrix"
        metafunc.parametrize("member", ADMITTED if asked else ADMITTED[:1], ids=" x ".join)


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    # The scene is tiny, and the tests themselves run in parallel.
    before = configure_threads()
    configure_threads(1)
    yield
    configure_threads(before)


@cache
def setup(row):
    return setup_of(config_of(row))


def default_densifier_of(backbone):
    return load("backbones", backbone).default_densifier


@pytest.mark.matrix
def test_exactly_the_listed_combinations_are_refused_for_the_listed_reasons():
    rows = every_combination()
    found = as_lines(refused(rows), rows)
    assert found == WRITTEN, "python -m support.refusals writes them anew"


@pytest.mark.parametrize("line", WRITTEN)
def test_a_run_of_a_refused_combination_reports_the_listed_reason(line):
    row = next(iter(from_lines([line], every_combination())))
    with pytest.raises(IncompatibleSelectionError) as refusal:
        setup(row)
    assert line.split(": ", 1)[1] in refusal.value.found


def test_the_design_contains_every_pair_of_components_that_can_work_together():
    met = {pair for row in DESIGN for pair in pairs_of(row)}
    assert met == {pair for row in ADMITTED for pair in pairs_of(row)}
    names = {(slot, name) for row in every_combination() for slot, name in enumerate(row)}
    assert names == {(slot, name) for row in DESIGN for slot, name in enumerate(row)}


def with_each_twice(rows):
    """The first rows in which some component is there for the first or second time."""
    found, times = set(), Counter()
    for row in rows:
        named = list(enumerate(row))
        if min(times[each] for each in named) < 2:
            found.add(row)
            times.update(named)
    return found


REPEATED = with_each_twice(DESIGN)
PAIRS_ONLY = [row for row in DESIGN if row not in REPEATED]


def require_same_again(row):
    run = train(setup(row), STEPS)
    require_sound(run)
    require_repeated(run, train(setup(row), STEPS))


@pytest.mark.parametrize("row", [row for row in DESIGN if row in REPEATED], ids=" x ".join)
def test_a_combination_trains_and_gives_the_same_bits_when_it_is_repeated(row):
    """Each component is used in at least two repeated runs."""
    require_same_again(row)


@pytest.mark.matrix
@pytest.mark.parametrize("row", PAIRS_ONLY, ids=" x ".join)
def test_every_pair_of_components_trains_repeatably(row):
    require_same_again(row)


@pytest.mark.parametrize("densifier", DENSIFIERS)
def test_density_control_edits_primitives_within_the_few_steps_of_the_test(densifier):
    rows = [row for row in DESIGN if row[SLOTS.index("densifier")] == densifier]
    # On its own backbone where there is one: others may leave it nothing to do in five steps.
    own = [row for row in rows if default_densifier_of(row[SLOTS.index("backbone")]) == densifier]
    row = [*own, *rows][0]
    records = train(setup(row), STEPS).records
    edits = [key for record in records for key, count in record.counts.items() if count]
    assert set(edits) - AGGREGATION


@pytest.mark.matrix
def test_every_member_of_the_full_product_trains(member):
    require_sound(train(setup(member), STEPS))
