"""One process that forks, one scene and one undisturbed run for all tests of faults."""

import os
import sys
from pathlib import Path

import pytest
from crossgrad_faults.runs import Nursery, undisturbed

from crossgrad_core.testing.scenes import write_tiny_scene

#: How many kills, and how many of the writes, in the short version; `make faults` sets more.
SHORT = 3


@pytest.fixture(scope="session")
def thorough():
    """How many faults of each kind; None means every one there is."""
    return int(os.environ["FAULTS"]) if "FAULTS" in os.environ else SHORT


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    scene = folder / "scene"
    write_tiny_scene(scene, views=6, suffix=".jpg")
    nursery = Nursery(folder, {**os.environ, "PYTHONWARNINGS": "default"})
    yield undisturbed(nursery, scene, folder / "undisturbed")
    nursery.close()


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.faults)
            if sys.platform == "win32":
                item.add_marker(pytest.mark.skip(reason="forks and signals of POSIX systems"))
