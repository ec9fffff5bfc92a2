"""Fixtures that tests of the contract checks share."""

import pytest

from crossgrad_core.testing.support import growth


@pytest.fixture
def short_windows(monkeypatch):
    """A state that grows is known after some dozens of steps instead of three thousand."""
    monkeypatch.setattr(growth, "_WINDOW", 20)
