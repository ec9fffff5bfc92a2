"""`crossgrad prepare`, killed at any instant, goes on to the result of an undisturbed one."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pycolmap
import pytest

from crossgrad_core.run.app import bundled_scene

#: Kills in the short version and in the long one, and photos of the bundled scene.
SHORT, LONG, COUNT = 2, 20, 7


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prepare") / "photos"
    folder.mkdir()
    for photo in sorted((bundled_scene() / "images").iterdir())[:COUNT]:
        shutil.copy(photo, folder)
    return folder


def start(photos, scene):
    command = [sys.executable, "-m", "crossgrad_core", "prepare", str(photos), str(scene)]
    with (scene.parent / "said.txt").open("ab") as file:
        return subprocess.Popen([*command, "--max-features", "1000"], stdout=file, stderr=file)


def result(photos, scene):
    """Registered photos and mean reprojection error, of the report and of the model."""
    assert start(photos, scene).wait() == 0, (scene.parent / "said.txt").read_text()
    found = json.loads((scene / "report.json").read_text())
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    assert model.num_reg_images() == found["registered"]
    assert len(list((scene / "images").iterdir())) == found["registered"]
    assert not list(scene.rglob("*.tmp"))
    return found["registered"], found["model"]["reprojection_error_px"]


@pytest.mark.slow
@pytest.mark.timeout(3600 if "FAULTS" in os.environ else 600)
def test_a_preparation_killed_at_random_instants_ends_with_the_same_result(photos, tmp_path):
    draw = random.Random(0)
    begun = time.monotonic()
    registered, error = result(photos, tmp_path / "undisturbed")
    seconds = time.monotonic() - begun
    assert registered == COUNT
    unfinished = 0
    for number in range(LONG if "FAULTS" in os.environ else SHORT):
        scene = tmp_path / str(number)
        process = start(photos, scene)
        try:
            process.wait(draw.uniform(0.0, seconds))
        except subprocess.TimeoutExpired:
            unfinished += 1
        process.kill()
        assert process.wait() in {0, -signal.SIGKILL}
        again, after = result(photos, scene)
        assert again == registered
        assert after == pytest.approx(error, rel=0.01)
    assert unfinished
