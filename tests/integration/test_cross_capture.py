"""A run on the views of another capture of its place."""

import csv
import shutil

import numpy as np
import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.postprocess import cross_capture as elsewhere_module
from crossgrad_core.run.postprocess import evaluate, render
from crossgrad_core.run.postprocess.cross_capture import _alike
from crossgrad_core.run.postprocess.drawn_file import DrawnFile
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

PLACE = {"scale": 7.0, "offset": (40.0, -20.0, 3.0)}


def without(scene, folder, gone):
    """The scene without some of its photos, whose cameras have another extent."""
    guard_pycolmap()
    import pycolmap

    shutil.copytree(scene, folder)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for image in list(model.images.values()):
        if gone(image.name):
            model.deregister_frame(image.frame_id)
            (folder / "images" / image.name).unlink()
    model.write_binary(folder / "sparse" / "0")
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "place"
    return write_tiny_scene(folder, views=9, folders=("street", "aerial"), **PLACE)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run that has seen the far photos alone."""
    root = tmp_path_factory.mktemp("run")
    far = without(scene, root / "far", lambda name: name.startswith("street"))
    settings = {"scene": str(far), "out": str(root / "run"), "steps": 20, "threads": 1}
    assert app.run(settings, verbosity=-1) == 0
    return root / "run"


def per_view(path):
    with path.open() as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_cross_capture_leaves_training_photos_out_and_repeats_held_out_metrics(
    trained, scene, capsys
):
    result, there = evaluate.evaluated_on(trained, scene)
    assert there.trained == 7 and len(result.views) == 11
    assert set(result.regimes) == {"street", "aerial"}
    rows, own = per_view(trained / "per_view_on_place.csv"), per_view(trained / "per_view.csv")
    assert len(rows) == 11 and set(own) == {name for name in rows if "aerial" in name}
    for name, row in own.items():
        # Their cameras took two local frames to get here: a rounded pixel may differ.
        assert float(rows[name]["psnr"]) == pytest.approx(float(row["psnr"]), abs=0.02)
    evaluate.evaluate(trained, on=scene)
    printed = capsys.readouterr().out
    assert "street" in printed and "left out: 7 views" in printed


@pytest.mark.slow
def test_a_ply_has_the_same_cross_capture_metrics_as_the_model(trained, scene, capsys):
    model, _ = evaluate.evaluated_on(trained, scene)
    before = sorted(trained.rglob("*"))
    cloud = DrawnFile(trained / "point_cloud.ply")
    file, gaussians, there = evaluate.evaluated_file(trained, cloud, on=scene)
    assert gaussians > 0 and there is not None and there.trained == 7
    for mine, other in zip(file.views, model.views, strict=True):
        assert mine.name == other.name
        # The model is vanilla on black: the file holds all of it, rounded to float32.
        assert mine.values["psnr"] == pytest.approx(other.values["psnr"], abs=0.02)
    evaluate.evaluate(trained, file=cloud, on=scene)
    printed = capsys.readouterr().out
    assert "rendered on black" in printed and "left out: 7 views" in printed
    assert sorted(trained.rglob("*")) == before


def test_views_of_the_other_capture_are_rendered_into_their_own_folder(trained, scene, tmp_path):
    render.render(trained, split="test", out=None, on=scene)
    (folder,) = (trained / "renders").glob("*/on_place")
    assert len(list(folder.glob("*.png"))) == 11
    render.render(trained, split="test", out=tmp_path / "own", on=scene)
    assert len(list((tmp_path / "own").iterdir())) == 11


def test_a_zoom_path_is_rendered_as_frames_and_a_video(trained, tmp_path, capsys):
    folder = tmp_path / "zoom"
    render.render_path(trained, "zoom", frames=3, out=folder)
    assert len(list(folder.glob("*.png"))) == 3
    (video,) = folder.glob("video.*")
    assert f"3 frames in {folder}, video {video}" in capsys.readouterr().out
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(UserError, match="the output file already exists"):
        render.render_path(trained, "zoom", frames=2, out=folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    # In the run's own folder a video takes the place of the one before.
    for frames in (3, 2):
        render.render_path(trained, "zoom", frames=frames, out=None)
    assert len(list((trained / "renders").glob("*/path_zoom/video.*"))) == 1
    with pytest.raises(UserError, match="applies only to a zoom path"):
        render.render_path(trained, "path.json", frames=2, out=None)


@pytest.mark.parametrize(
    ("options", "idle", "other"),
    [
        (("--on", "scene", "--path", "zoom"), "--on", "--path"),
        (("--split", "train", "--path", "zoom"), "--split", "--path"),
        (("--split", "test", "--on", "scene"), "--split", "--on"),
        (("--frames", "9"), "--frames", "--path zoom"),
        (("--frames", "100001", "--path", "zoom"), "--frames", "100000"),
        (("--frames", "9", "--on", "scene"), "--frames", "--path zoom"),
        (("--frames", "9", "--path", "tour.json"), "--frames", "zoom"),
    ],
)
def test_options_without_an_effect_are_refused(trained, options, idle, other, capsys):
    before = sorted(trained.rglob("*"))
    assert ended("render", trained, *options) == 2
    said = capsys.readouterr().err
    assert idle in said and other in said and "Traceback" not in said
    assert sorted(trained.rglob("*")) == before


def test_captures_that_cannot_be_compared_are_refused(trained, scene, tmp_path):
    before = sorted(trained.rglob("*"))
    # Without a second photo there are no points left: none are needed.
    only = without(scene, tmp_path / "only", lambda name: name != "aerial/0001.png")
    with pytest.raises(UserError, match="trained on all views"):
        evaluate.evaluate(trained, on=only)
    away = {**PLACE, "offset": (4000.0, -20.0, 3.0)}
    far_away = write_tiny_scene(tmp_path / "away", views=3, **away)
    with pytest.raises(UserError, match=r"does not overlap(.|\n)*0% of the capture's points"):
        evaluate.evaluate(trained, on=far_away)
    with pytest.raises(UserError):
        evaluate.evaluate(trained, on=tmp_path / "nothing")
    assert sorted(trained.rglob("*")) == before
    assert np.isfinite(float(per_view(trained / "per_view.csv")["aerial/0000.png"]["psnr"]))


@pytest.mark.slow
def test_scenes_with_the_same_name_get_separate_tables(trained, scene, tmp_path):
    table = trained / "per_view_on_place.csv"
    evaluate.evaluated_on(trained, scene)
    before = table.read_text()
    (tmp_path / "other").mkdir()
    fewer = without(scene, tmp_path / "other" / "place", lambda name: name == "street/0001.png")
    for _ in range(2):
        evaluate.evaluated_on(trained, fewer)
        assert table.read_text() == before
        assert len(per_view(trained / "per_view_on_place-2.csv")) < len(per_view(table))
    assert not (trained / "per_view_on_place-3.csv").exists()


def test_a_scene_that_two_readers_accept_is_read_by_the_reader_of_the_run(trained, scene, tmp_path):
    both = shutil.copytree(scene, tmp_path / "place")
    (both / "transforms.json").write_text('{"frames": []}')
    result, _ = evaluate.evaluated_on(trained, both)
    assert len(result.views) == 11


def surface(seed, count):
    """Points of a wavy sheet in a box of about one unit, another one for each seed."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = rng.uniform(-1, 1, (count, 2))
    waves = 0.3 * np.sin(3 * flat[:, 0] + seed) * np.cos(4 * flat[:, 1])
    return np.column_stack([flat, waves]) @ turn.T


def test_captures_of_one_place_are_distinguished_from_captures_of_another_place():
    whole = surface(1, 6000)
    own, other = whole[:4000], whole[4000:]
    # Another capture shows a part of it, from nearby or with much around.
    assert _alike(own, other)
    assert _alike(own, other[other[:, 0] > 0.2])
    assert _alike(own, np.concatenate([other, 3 * surface(5, 500)]))
    assert not any(_alike(own, surface(seed, 2000)) for seed in range(2, 8))
    # Of a few points nothing can be told.
    assert _alike(own, surface(2, 20))


@pytest.mark.slow
def test_a_capture_of_another_place_is_measured_with_a_warning(trained, scene, capsys, monkeypatch):
    monkeypatch.setattr(elsewhere_module, "_alike", lambda own, points: False)
    evaluate.evaluate(trained, on=scene)
    assert "the run show the same place" in capsys.readouterr().out
    render.render(trained, split="test", out=None, on=scene)
    assert "the run show the same place" in capsys.readouterr().out
