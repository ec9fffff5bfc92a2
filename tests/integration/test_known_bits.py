"""Short trainings keep their bits on processors that are known, and their figures on all.

A change of bits is a decision: `python -m support.known_bits` in tests/ writes it down.
"""

import pytest
from support import known_bits

#: What processors may differ by, of the root mean square of a tensor or of full brightness.
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def reference():
    """What is known of this processor, else what another one made; and whether it is known."""
    known, ours = known_bits.known(), known_bits.key()
    return known.get(ours, next(reversed(known.values()))), ours in known


def test_this_processor_is_known(reference):
    if not reference[1]:
        ours = known_bits.key()
        pytest.skip(f"no bits of {ours}: figures are compared to {TOLERANCE:g} instead")


@pytest.mark.parametrize("name", known_bits.CASES)
def test_bits_or_figures_are_the_known_ones(name, reference, tmp_path):
    expected, exact = reference
    found = known_bits.made(name, tmp_path)
    if exact:
        assert found == expected[name]
    else:
        figures = expected[name]["figures"]
        assert found["figures"].keys() == figures.keys()
        for tensor, numbers in figures.items():
            size = 1.0 if tensor == "render" else abs(numbers[-1])
            assert found["figures"][tensor] == pytest.approx(numbers, abs=TOLERANCE * size)


def test_every_known_processor_has_all_cases():
    for results in known_bits.known().values():
        assert results.keys() == known_bits.CASES.keys()
