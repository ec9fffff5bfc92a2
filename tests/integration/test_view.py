"""The viewer shows runs exactly, while they train and afterwards, to this machine only."""

import importlib.util
import json
import socket
import time
from contextlib import suppress
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
import torch
from PIL import Image
from support.commands import ended
from support.scenes import write_tiny_scene
from support.viewer_client import window
from websockets.exceptions import ConnectionClosed

import crossgrad_core as cg
from crossgrad_core.config import ComponentChoice
from crossgrad_core.contract.scene import to_uint8
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.postprocess import render
from crossgrad_core.run.results.summary import read_summary
from crossgrad_plugins.view.app import open_viewer
from crossgrad_plugins.view.cameras import fov_of

STEPS = 4
FOV = 0.9


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=5, folders=("street", "aerial"))


def train(scene, out, viewer=None, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": STEPS, "threads": 1, **settings}
    return app.run(given, verbosity=-1, viewer=viewer)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run of a backbone that a file holds only after baking."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert train(scene, out, backbone={"name": "scaffold"}) == 0
    return out


@pytest.fixture
def viewer(trained):
    viewer = open_viewer(trained, port=0)
    yield viewer
    viewer.close()


def rounded(image):
    return to_uint8(torch.from_numpy(image)).numpy()


def inner(frame, like):
    """The middle of a frame, which has black borders around a photo."""
    top, left = ((a - b) // 2 for a, b in zip(frame.shape[:2], like.shape[:2], strict=True))
    return frame[top : top + like.shape[0], left : left + like.shape[1]]


def shown(page, view):
    """The lossless frame after the page's camera went to a view."""
    page.set("Go to", view.name)
    return page.moved(view.camera, fov_of(view.camera))


def test_a_frame_equals_the_render_of_an_evaluation(viewer, trained):
    run = cg.open(trained)
    for view in (run.scene.test_views[0], run.scene.train_views[1]):
        expected = rounded(run.render(view.name))
        with window(viewer.url) as page:
            page.open(view.camera, FOV)
            page.still()
            found = inner(shown(page, view), expected)
        np.testing.assert_array_equal(found, expected)


def test_a_recorded_path_is_rendered_with_the_frames_of_the_viewer(
    viewer, trained, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    scene = cg.open(trained).scene
    frames = []
    with window(viewer.url) as page:
        page.open(scene.train_views[0].camera, FOV)
        page.still()
        for count, view in enumerate(scene.train_views[:2], start=1):
            # A field of view of its own makes the window a free camera of the same pose.
            far = replace(view.camera, world_to_camera=view.camera.world_to_camera.clone())
            far.world_to_camera[2, 3] += 0.2
            frames.append(page.moved(far, FOV))
            page.press("Add keyframe")
            page.until(lambda count=count: page.says(f"{count} keyframes"))
        page.press("Save the path")
        page.until((tmp_path / "camera_path.json").exists)
    assert len(json.loads((tmp_path / "camera_path.json").read_text())["camera_path"]) == 49
    render.render_path(trained, str(tmp_path / "camera_path.json"), out=tmp_path / "frames")
    files = sorted((tmp_path / "frames").glob("*.png"))
    for frame, file in ((frames[0], files[0]), (frames[1], files[-1])):
        drawn = np.asarray(Image.open(file).convert("RGB"))
        assert np.abs(frame.astype(int) - drawn).max() <= 1
        assert (frame != drawn).mean() < 0.001


def test_frames_are_small_while_the_camera_moves(viewer, trained):
    camera = cg.open(trained).scene.train_views[0].camera
    with window(viewer.url) as page:
        assert page.open(camera, FOV, size=(640, 480)).shape[0] < 300
        page.still()
        page.look(camera, FOV + 0.1, size=(640, 480))
        assert page.frame().shape[0] < 480
        assert page.still().shape == (480, 640, 3)


def test_numbers_that_are_no_camera_are_ignored(viewer, trained):
    camera = cg.open(trained).scene.train_views[0].camera
    with window(viewer.url) as page:
        page.open(camera, FOV)
        page.still()
        for fov, size in ((float("nan"), (96, 64)), (FOV, (0, 64)), (FOV, (96, 10**6))):
            page.look(camera, fov, size=size)
        page.look(camera, FOV + 0.1)
        assert page.still().shape == (64, 96, 3)


def test_a_run_in_training_is_shown_paused_and_stopped(scene, tmp_path):
    port, out, frames = free_port(), tmp_path / "run", []

    def watch():
        url = f"http://127.0.0.1:{port}"
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        with window(url) as page:
            frames.append(page.open(camera, FOV))
            page.press("Pause")
            page.still()
            frames.append(shown(page, view))
            page.press("Stop")
            with suppress(ConnectionClosed):  # The viewer ends with the run.
                page.take(5.0)

    view = cg.open(train_once(scene, tmp_path / "other")).scene.test_views[0]
    camera = view.camera
    watcher = Thread(target=watch)
    watcher.start()
    choice = ComponentChoice.model_validate({"name": "view", "port": port, "share": 1.0})
    assert train(scene, out, viewer=choice, steps=500) == 0
    watcher.join(30.0)
    assert read_summary(out)["status"] == "stopped"
    assert frames[0].shape[0] < 64
    expected = rounded(cg.open(out).render(view.name))
    np.testing.assert_array_equal(inner(frames[1], expected), expected)
    assert "observers: []" in (out / "config.yaml").read_text()


def train_once(scene, out):
    assert train(scene, out, steps=2) == 0
    return out


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_taken_port_is_refused_before_anything_is_read(capsys, tmp_path, scene):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert ended("view", tmp_path / "nothing", "--port", port) == 2
        assert f"port {port} is taken" in capsys.readouterr().err
        out = tmp_path / "run"
        assert ended("run", scene, "--steps", 2, "--out", out, "--view", "--port", port) == 2
        assert f"port {port} is taken" in capsys.readouterr().err
        assert not out.exists()


def test_a_missing_viser_is_named(monkeypatch, capsys, tmp_path):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name == "viser" else find(name, *rest),
    )
    assert ended("view", tmp_path) == 2
    assert "pip install 'crossgrad[view]'" in capsys.readouterr().err


def test_only_this_machine_reaches_the_viewer(viewer):
    port = int(viewer.url.rpartition(":")[2])
    for address, reached in (("127.0.0.1", True), ("127.0.0.2", False)):
        with socket.socket() as probe:
            assert (probe.connect_ex((address, port)) == 0) == reached


def test_a_window_cannot_ask_for_a_public_address(viewer, trained):
    with window(viewer.url) as page:
        page._send("ShareUrlRequest")
        page.look(cg.open(trained).scene.train_views[0].camera, FOV)
        page.still()
    assert viewer._server.request_share_url() is None
    assert viewer._server._share_tunnel is None


def test_a_notebook_shows_the_viewer_inline(viewer):
    assert f'<iframe src="{viewer.url}"' in viewer._repr_html_()


def test_a_path_that_is_nothing_to_view_is_refused(tmp_path):
    with pytest.raises(UserError, match="there is nothing to view"):
        open_viewer(tmp_path / "nothing", port=0)


@pytest.mark.parametrize("option", ["--host", "--port"])
def test_an_address_without_the_viewer_is_refused(option, capsys, scene):
    assert ended("run", scene, option, "8080") == 2
    assert "no effect without --view" in capsys.readouterr().err
