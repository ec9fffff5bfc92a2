"""A scene that contradicts itself, from the command line and in a run."""

import json
import subprocess
import sys

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.results.config_file import read_config
from crossgrad_plugins.scene_check.app import lines_of


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A right scene, one with a principal point of (0, 0), and one with two photos exchanged."""
    root = tmp_path_factory.mktemp("scenes")
    for name in ("right", "wrong", "exchanged"):
        write_tiny_scene(root / name, views=10, width=96, height=64, points=500, text=True)
    cameras = root / "wrong" / "sparse" / "0" / "cameras.txt"
    *fields, _, _ = cameras.read_text().splitlines()[-1].split()
    cameras.write_text(" ".join([*fields, "0", "0"]) + "\n")
    images = root / "exchanged" / "images"
    (images / "0003.png").rename(images / "other")
    (images / "0006.png").rename(images / "0003.png")
    (images / "other").rename(images / "0006.png")
    return root


def settings(scenes, name, out):
    return {"scene": str(scenes / name), "out": str(out), "steps": 2}


def test_a_contradictory_scene_is_refused_with_the_cause_before_writing(scenes, tmp_path):
    with pytest.raises(UserError, match="do not match its poses and points") as error:
        app.run(settings(scenes, "wrong", tmp_path / "run"), verbosity=-1)
    assert "principal point" in error.value.found
    assert not (tmp_path / "run").exists()


def test_an_accepted_contradictory_scene_is_trained_and_its_configuration_repeats_the_run(
    scenes, tmp_path
):
    run = tmp_path / "run"
    asked = settings(scenes, "wrong", run)
    assert app.run(asked, verbosity=-1, accept_scene=True) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["scene_check"]["verdict"] == "points, poses and photos do not match"
    assert any("principal point" in note for note in summary["notes"])
    repeated = {**read_config(run), "out": str(tmp_path / "again")}
    assert app.run(repeated, verbosity=-1) == 0


def test_a_stopped_run_of_an_accepted_contradictory_scene_can_be_resumed(scenes, tmp_path):
    run = tmp_path / "run"
    asked = {**settings(scenes, "wrong", run), "stop_after": 1}
    assert app.run(asked, verbosity=-1, accept_scene=True) == 0
    assert app.run({}, resume=run, verbosity=-1) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["scene_check"]["verdict"] == "points, poses and photos do not match"


def test_summary_json_has_the_numbers_of_a_consistent_scene(scenes, tmp_path):
    assert app.run(settings(scenes, "right", tmp_path / "run"), verbosity=-1) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    found = summary["scene_check"]
    assert (found["verdict"], found["compared"], found["warnings"]) == ("agrees", 10, [])
    assert found["correlation"] > 0.8
    assert not [note for note in summary["notes"] if note.startswith("check:")]


def test_check_prints_inconsistent_photos_first_and_the_verdict_last(scenes):
    lines = lines_of(scenes / "exchanged", [])
    assert "0003.png, 0006.png" in lines[0]
    assert lines[-1].startswith("verdict: some photos do not match; 10 of 10 photos")
    assert len(lines) <= 15


def test_check_of_a_consistent_scene_prints_no_warning(scenes):
    lines = lines_of(scenes / "right", ["data.max_size=64"])
    assert not [line for line in lines if line.startswith("check:")]
    assert lines[-1].startswith("verdict: agrees")


def test_check_ends_with_code_2_and_the_cause_if_the_scene_is_refused(scenes):
    command = [sys.executable, "-m", "crossgrad_core", "check", str(scenes / "wrong")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "do not match its poses and points" in done.stderr
    assert "principal point" in done.stderr
    assert "Traceback" not in done.stderr
