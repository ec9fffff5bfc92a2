"""Initializers in whole runs."""

import json

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.registry.entries import entries, load
from crossgrad_core.run import app
from crossgrad_core.run.results.config_file import read_config, read_notes

BASE = ["--steps", "8", "--threads", "1", "--max-size", "40", "--views", "2", "-q"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def primitives(folder):
    return json.loads((folder / "summary.json").read_text())["primitives"]


def run(scene, out, *options):
    return ended("run", str(scene), *BASE, "--out", str(out), *options)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("backbone", ["vanilla", "scaffold"])
def test_the_default_initializer_fills_gaps_and_reports_so(scene, tmp_path, backbone):
    options = ("--backbone", backbone, "--densifier", "none")
    assert run(scene, tmp_path / "plain", *options, "--initializer", "points") == 0
    assert run(scene, tmp_path / "filled", *options) == 0
    assert primitives(tmp_path / "filled") > primitives(tmp_path / "plain")
    assert any(note.startswith("start: ") for note in read_notes(tmp_path / "filled"))
    assert not any(note.startswith("start: ") for note in read_notes(tmp_path / "plain"))


@pytest.mark.slow
def test_a_resumed_run_has_the_same_bits(scene, tmp_path):
    options = ("--initializer", "fill-gaps", "--set", "initializer.cells=6")
    assert run(scene, tmp_path / "whole", *options) == 0
    assert run(scene, tmp_path / "broken", *options, "--stop-after", "4") == 0
    assert ended("run", "--resume", str(tmp_path / "broken"), "-q") == 0
    one, other = (
        (tmp_path / name / "point_cloud.ply").read_bytes() for name in ("whole", "broken")
    )
    assert one == other


@pytest.mark.sampled(1)
@pytest.mark.parametrize("options", [("--init", "random"), ("--recipe", "published")], ids=str)
def test_options_that_exclude_filling_use_the_points_initializer(scene, tmp_path, options):
    """The written configuration names the points initializer and repeats the run."""
    assert run(scene, tmp_path / "run", *options) == 0
    stored = read_config(tmp_path / "run")
    assert stored["initializer"] == {"name": "points"}
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """Gives a scene with that many points; its photos are large enough to have features."""
    root = tmp_path_factory.mktemp("sparse")

    def made(points):
        folder = root / str(points)
        size = {"width": 240, "height": 160}
        return folder if folder.exists() else write_tiny_scene(folder, points=points, **size)

    return made


@pytest.mark.sampled(1)
@pytest.mark.parametrize("points", [0, 1, 2])
@pytest.mark.parametrize("initializer", sorted(entries("initializers")))
def test_every_initializer_trains_a_scene_with_few_or_no_points(
    sparse, tmp_path, capsys, initializer, points
):
    given = ("--steps", "4", "--threads", "1", "-q", "--out", tmp_path / "run")
    trains = points or load("initializers", initializer).alone
    assert ended("run", sparse(points), *given, "--initializer", initializer) == (
        0 if trains else 2
    )
    if trains:
        assert primitives(tmp_path / "run") >= max(points, 1)
    else:
        assert "the scene has no SfM points to start from" in capsys.readouterr().err


def test_an_initializer_together_with_init_random_is_refused(scene, tmp_path, capsys):
    assert run(scene, tmp_path / "run", "--init", "random", "--initializer", "fill-gaps") == 2
    assert "initializer: --init random has its own points" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
