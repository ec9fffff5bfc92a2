"""Short trainings keep their bits on processors that are known.

A change of bits is a decision: `python -m support.known_bits` in tests/ writes it down. Processors
that round differently train differently from the first steps on: `make bits` compares two commits
on any of them.
"""

import pytest
from support import known_bits


@pytest.fixture(scope="module")
def reference():
    """What is known of this processor."""
    ours = known_bits.key()
    if ours not in known_bits.known():
        pytest.skip(f"no bits are known of {ours}")
    return known_bits.known()[ours]


@pytest.mark.parametrize("name", known_bits.CASES)
def test_bits_are_the_known_ones(name, reference, tmp_path):
    assert known_bits.made(name, tmp_path) == reference[name]


def test_every_known_processor_has_all_cases():
    for results in known_bits.known().values():
        assert results.keys() == known_bits.CASES.keys()
