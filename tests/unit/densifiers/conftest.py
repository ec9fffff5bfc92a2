"""Fixtures that the tests of densifiers share."""

import pytest

#: What density control counts where it edits.
EDITS = ("cloned", "split", "pruned", "grown", "added", "relocated")


@pytest.fixture
def edits_in():
    """Primitives that the records of some steps say were edited."""
    return lambda records: sum(each.counts.get(kind, 0) for each in records for kind in EDITS)
