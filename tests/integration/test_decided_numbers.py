"""Every number that a run decides by itself is the one that is written down."""

import json

import pytest
from support.decided import PATH, as_json, combinations, decided

CHUNK = 25
KNOWN = json.loads(PATH.read_text(encoding="utf-8"))
CHOSEN = list(combinations())


def test_the_file_of_recorded_numbers_contains_all_combinations_of_settings():
    assert [name for name, _ in CHOSEN] == [*KNOWN]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("first", range(0, len(CHOSEN), CHUNK))
def test_automatically_chosen_settings_equal_the_recorded_settings(first):
    chunk = CHOSEN[first : first + CHUNK]
    found = {name: json.loads(as_json(decided(settings))) for name, settings in chunk}
    assert found == {name: KNOWN[name] for name, _ in chunk}
