"""A run exports Gaussians to other formats, and its commands read these files."""

import json
import re
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.commands import ended
from support.scenes import write_tiny_scene

import crossgrad_core as cg

STEPS = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=5)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "run"
    settings = {"steps": STEPS, "threads": 1, "save_every": 2, "quiet": True}
    return cg.run(scene, out=out, **settings).folder


@pytest.fixture(scope="module")
def files(trained):
    """The run's folder after an export to each format that loses something."""
    for name in ("sog", "splat"):
        assert ended("export", trained, "--format", name) == 0
    return trained


def psnr(capsys, *command):
    """The overall PSNR that `crossgrad eval` prints, and all that it prints."""
    capsys.readouterr()
    assert ended("eval", *command, "--threads", "1") == 0
    printed = capsys.readouterr().out
    return float(re.search(r"^overall +\d+ +(\S+)", printed, re.MULTILINE)[1]), printed


@pytest.mark.parametrize("name", ["sog", "splat"])
def test_summary_names_the_loss_that_the_file_has_when_it_is_read_again(files, name, capsys):
    exports = json.loads((files / "summary.json").read_text())["exports"]
    assert exports.keys() >= {"point_cloud.ply", "point_cloud.sog", "point_cloud.splat"}
    told = exports[f"point_cloud.{name}"]
    assert told["loss"] == pytest.approx(told["live_psnr"] - told["psnr"])
    found, printed = psnr(capsys, files, "--file", files / f"point_cloud.{name}")
    assert found == pytest.approx(told["psnr"], abs=6e-3)
    assert f"{told['gaussians']} Gaussians of" in printed


@pytest.mark.parametrize("name", ["sog", "splat"])
def test_a_run_starts_from_each_format(files, scene, name, tmp_path):
    init = str(files / f"point_cloud.{name}")
    again = cg.run(scene, init=init, steps=1, threads=1, quiet=True, out=tmp_path / "run")
    told = json.loads((files / "summary.json").read_text())
    assert again.summary["primitives"] == told["exports"][f"point_cloud.{name}"]["gaussians"]


def test_eval_draws_a_file_by_the_rules_of_a_viewer(files, capsys):
    file = files / "point_cloud.ply"
    own, _ = psnr(capsys, files, "--file", file)
    for viewer in ("playcanvas", "mkkellogg", "spark", "cesium"):
        found, printed = psnr(capsys, files, "--file", file, "--as", viewer)
        assert f"by the rules of {viewer}" in printed
        assert found != own and abs(found - own) < 6.0
    result = cg.open(files, threads=1).evaluate(file, viewer="cesium")
    assert result.overall["psnr"] == pytest.approx(found, abs=6e-3)


def test_render_draws_the_gaussians_of_a_file_into_a_folder_of_its_own(files, capsys):
    assert ended("render", files, "--file", files / "point_cloud.sog", "--as", "spark") == 0
    folder = files / "renders" / f"{STEPS:06d}" / "of_point_cloud.sog" / "spark"
    assert list(folder.glob("*.png"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--as", "spark"), "no effect without --file"),
        (("--file", "x.txt"), "a name that ends in"),
        (("--file", "x.sog"), "cannot be read"),
        (("--file", "point_cloud.ply", "--as", "nobody"), "there is no viewer named 'nobody'"),
    ],
)
def test_wrong_options_are_one_error(files, options, words, capsys, monkeypatch):
    monkeypatch.chdir(files)
    assert ended("eval", ".", *options) == 2
    told = capsys.readouterr().err
    assert words in told and "Traceback" not in told


def test_an_evolution_has_a_frame_of_each_kept_checkpoint(trained, capsys):
    assert ended("render", trained, "--evolution") == 0
    folder = trained / "renders" / f"{STEPS:06d}" / "evolution"
    frames = sorted(folder.glob("*.png"))
    assert [frame.name for frame in frames] == ["00000.png", "00001.png", "00002.png"]
    assert list(folder.glob("video.*"))
    pictures = [Image.open(frame).tobytes() for frame in frames]
    assert pictures[0] != pictures[-1]


def test_an_evolution_of_one_checkpoint_names_the_option_that_keeps_more(trained, tmp_path, capsys):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    for checkpoint in sorted((run / "checkpoints").iterdir())[:-1]:
        shutil.rmtree(checkpoint)
    assert ended("render", run, "--evolution") == 2
    told = capsys.readouterr().err
    assert "--save-every N" in told and "1 checkpoint" in told


def test_an_evolution_takes_no_option_of_other_pictures(trained, capsys):
    for option in (("--path", "zoom"), ("--split", "all"), ("--file", "a.ply")):
        assert ended("render", trained, "--evolution", *option) == 2
        assert "no effect together with --evolution" in capsys.readouterr().err
