"""What all tests share.

Runs do not draw their curve, which is half of the time of a tiny one. Threads that wait do not
spin: the processes of the tests share the cores, and spinning took as much time as the work.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Before torch and numba are imported.

import pytest
from PIL import Image

from crossgrad_core.run.results.curve import FILE, draw_curve

SESSION = "crossgrad_core.run.session.draw_curve"


def without_drawing(folder, *_):
    """The file that stands where the curve would."""
    Image.new("L", (1, 1)).save(folder / FILE)
    return folder / FILE


@pytest.fixture(scope="session", autouse=True)
def _undrawn():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SESSION, without_drawing)
        yield


@pytest.fixture
def drawn(monkeypatch):
    """Runs of this process draw their curve."""
    monkeypatch.setattr(SESSION, draw_curve)
