"""Runs of which a folder or file was moved or removed: what there is stays, and no half is made."""

import shutil

import numpy as np
import pytest
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.camera_path import ZOOM
from crossgrad_core.run.postprocess import evaluate, export, render
from crossgrad_core.run.results import video
from crossgrad_core.run.results.summary import read_summary
from crossgrad_core.run.session import Session


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, scene):
    out = tmp_path_factory.mktemp("whole") / "run"
    settings = {"scene": str(scene), "out": str(out), "steps": 6, "eval_every": 2}
    assert app.run(settings, verbosity=-1) == 0
    return out


@pytest.fixture
def run(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


def contents(folder):
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "run.lock")
    return {path.relative_to(folder): path.read_bytes() for path in files}


@pytest.mark.parametrize("status", ["finished", "stopped"])
def test_results_without_checkpoints_are_not_overwritten_by_a_restart(run, status):
    shutil.rmtree(run / "checkpoints")
    summary = (run / "summary.json").read_text()
    (run / "summary.json").write_text(summary.replace('"finished"', f'"{status}"'))
    before = contents(run)
    for act in (
        lambda: app.run({}, resume=run, verbosity=-1),
        lambda: evaluate.evaluate(run),
        lambda: export.export(run, file_format="ply", out=None),
    ):
        with pytest.raises(UserError, match="the checkpoints of the run are missing") as refused:
            act()
        assert refused.value.expected.startswith("the checkpoint of step 6")
        assert contents(run) == before


def test_a_run_that_failed_without_a_checkpoint_is_restarted(run):
    shutil.rmtree(run / "checkpoints")
    summary = (run / "summary.json").read_text()
    (run / "summary.json").write_text(summary.replace('"finished"', '"failed"'))
    assert app.run({}, resume=run, verbosity=-1) == 0
    assert read_summary(run)["status"] == "finished"


@pytest.mark.parametrize("name", ["per_view.csv", "point_cloud.ply"])
def test_a_missing_result_file_is_added(run, name):
    before = (run / name).read_bytes()
    (run / name).unlink()
    assert app.run({}, resume=run, verbosity=-1) == 0
    assert (run / name).read_bytes() == before
    with pytest.raises(UserError, match="the run is finished"):
        app.run({}, resume=run, verbosity=-1)


@pytest.mark.parametrize("act", ["evaluate", "save"])
def test_a_folder_moved_during_a_run_is_not_created_again(run, act):
    setup, state = cg.open(run)._open()
    session = Session.resumed(run, setup, 5)
    run.rename(run.with_name("moved"))
    with pytest.raises(UserError, match="the folder of the run no longer exists"):
        getattr(session, act)(setup, state)
    assert not run.exists()


def test_a_run_whose_folder_is_moved_gives_one_error(scene, tmp_path, monkeypatch, capsys):
    out, original = tmp_path / "run", Session.save

    def moved(session, setup, state):
        if out.exists():
            out.rename(tmp_path / "moved")
        original(session, setup, state)

    monkeypatch.setattr(Session, "save", moved)
    settings = {"scene": str(scene), "out": str(out), "steps": 6, "save_every": 3}
    assert app.run(settings, verbosity=-1) == 1
    said = capsys.readouterr()
    assert "the folder of the run no longer exists" in said.err
    for words in ("no curve.png", "the traceback", "continue with", "results in"):
        assert words not in said.err + said.out
    assert not out.exists()
    assert app.run({}, resume=tmp_path / "moved", verbosity=-1) == 0


def test_a_shorter_video_leaves_no_frames_of_a_longer_one(run):
    for frames, count in ((4, 4), (3, 3)):
        render.render_path(run, path=ZOOM, frames=frames, out=None)
        assert len(list(run.glob("renders/*/path_zoom/0*.png"))) == count


def test_a_checkpoint_has_the_same_permissions_as_other_files(run):
    files = [path for path in run.rglob("*") if path.is_file() and path.name != "run.lock"]
    assert any(path.name == "tensors.safetensors" for path in files)
    (run / "fresh").touch()
    assert {path.stat().st_mode for path in files} == {(run / "fresh").stat().st_mode}


def shows(model, image, point):
    where = model.images[image].project_point(point)
    camera = model.cameras[model.images[image].camera_id]
    return where is not None and bool(
        (where >= 0).all() and (where <= (camera.width, camera.height)).all()
    )


def test_points_that_no_photo_shows_are_refused(scene, tmp_path):
    import pycolmap

    away = shutil.copytree(scene, tmp_path / "away")
    model = pycolmap.Reconstruction(away / "sparse" / "0")
    ends = [sign * 1e6 * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    hidden = next(end for end in ends if not any(shows(model, i, end) for i in model.images))
    for point in model.points3D.values():
        point.xyz = hidden
    model.write(away / "sparse" / "0")
    settings = {"scene": str(away), "out": str(tmp_path / "run"), "steps": 2}
    with pytest.raises(UserError, match="do not match its poses and points"):
        app.run(settings, verbosity=-1)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("seed: 0", "seed: 3", "seed"),
        ("ssim_weight: 0.2", "ssim_weight: 0.9", "loss.ssim_weight"),
        ("background: black", "background: white", "background"),
        ("steps: 6", "steps: 8", "steps"),
    ],
)
def test_a_changed_configuration_file_is_refused(run, old, new, named):
    text = (run / "config.yaml").read_text()
    assert text.count(old) == 1
    (run / "config.yaml").write_text(text.replace(old, new))
    before = contents(run)
    for act in (lambda: app.run({}, resume=run, verbosity=-1), lambda: evaluate.evaluate(run)):
        with pytest.raises(
            UserError, match=r"settings in config.yaml have changed since"
        ) as refused:
            act()
        assert refused.value.where == f"settings {named}; step 6"
        assert contents(run) == before


def test_settings_that_do_not_affect_training_may_be_changed(run):
    text = (run / "config.yaml").read_text()
    assert "eval_every: 2" in text
    (run / "config.yaml").write_text(text.replace("eval_every: 2", "eval_every: 3"))
    evaluate.evaluate(run)


def test_an_outdated_video_is_removed_if_no_new_video_is_made(run, monkeypatch, capsys):
    render.render_path(run, path=ZOOM, frames=3, out=None)
    (made,) = run.glob("renders/*/path_zoom/video.*")
    monkeypatch.setattr(video, "_LARGEST", 100)
    monkeypatch.setattr(video.shutil, "which", lambda _: None)
    render.render_path(run, path=ZOOM, frames=3, out=None)
    assert not made.exists()
    assert (
        "no video was written: there are too many frames, or they are too large without ffmpeg"
        in capsys.readouterr().out
    )
