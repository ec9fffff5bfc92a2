"""Fixtures that tests of several packages share."""

from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.testing.fixtures import sample_scene

#: torch shares out what has more than 32,768 elements; a share that no vector length divides.
ROWS = 40_001


@pytest.fixture
def keeps_threads():
    """The number of threads after the test is that before it."""
    before = configure_threads()
    yield
    configure_threads(before)


@pytest.fixture(scope="session")
def large_scene():
    """The sample scene with so many points that threads share them, spread as its own are."""
    scene, rng = sample_scene(), np.random.default_rng(0)
    points = scene.points.mean(0) + scene.points.std(0) * rng.normal(size=(ROWS, 3))
    colors = rng.integers(0, 256, (ROWS, 3), dtype=np.uint8)
    return replace(scene, points=points, point_colors=colors)
