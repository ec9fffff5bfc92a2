"""Short trainings keep their bits on processors that are known.

A change of bits is a decision: `python -m support.known_bits` in tests/ writes it down. Processors
that round differently train differently from the first steps on: `make bits` compares two commits
on any of them.
"""

import pytest
from support import known_bits

from crossgrad_core.numerics import jobs


@pytest.fixture(scope="module")
def reference():
    """What is known of this processor."""
    ours = known_bits.key()
    if ours not in known_bits.known():
        pytest.skip(f"no bits are known of {ours}")
    return known_bits.known()[ours]


@pytest.mark.parametrize("name", known_bits.CASES)
def test_trained_bits_equal_the_recorded_bits(name, reference, tmp_path):
    assert known_bits.made(name, tmp_path) == reference[name]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["vanilla", "scaffold", "exposure"])
def test_bits_do_not_depend_on_the_thread_that_does_a_job(name, monkeypatch, tmp_path):
    usual = known_bits.made(name, tmp_path / "usual")
    of_threads = jobs._jobs
    # As if the last of three threads did all of them, from its own ones on.
    monkeypatch.setattr(jobs, "_jobs", lambda _: of_threads(3)[2:])
    assert known_bits.made(name, tmp_path / "turned") == usual


def test_every_known_processor_has_results_for_all_cases():
    for results in known_bits.known().values():
        assert results.keys() == known_bits.CASES.keys()
