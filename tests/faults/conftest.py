"""One process that forks, one scene and one undisturbed run for all tests of faults."""

import os
import sys
from pathlib import Path

import pytest
from crossgrad_faults.runs import Nursery, undisturbed
from support.scenes import write_tiny_scene

#: How many kills, and how many of the writes, in the short version; `make faults` sets more.
SHORT = 1


@pytest.fixture(scope="session")
def thorough():
    """How many faults of each kind; None means every one there is."""
    return int(os.environ["FAULTS"]) if "FAULTS" in os.environ else SHORT


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    scene = folder / "scene"
    write_tiny_scene(scene, views=6, suffix=".jpg")
    install_plugin(folder)
    here = Path(__file__).parent
    found = (os.environ.get("PYTHONPATH"), str(folder), str(here), str(here.parent))
    path = os.pathsep.join(filter(None, found))
    nursery = Nursery(folder, {**os.environ, "PYTHONPATH": path}, scene)
    yield undisturbed(nursery, scene, folder / "undisturbed")
    nursery.close()


def install_plugin(folder):
    """Makes the observer `faulty` known to each process with the folder on its path."""
    info = folder / "faulty-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[crossgrad.observers]\nfaulty = crossgrad_faults.faulty_plugin:Faulty\n"
    )


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.faults)
            if sys.platform == "win32":
                item.add_marker(pytest.mark.skip(reason="forks and signals of POSIX systems"))
