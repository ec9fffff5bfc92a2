"""Frames: the layers of sources, left and right of the split line."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from crossgrad_core.contract.scene import Camera, Similarity, View
from crossgrad_plugins.view.cameras import Fit
from crossgrad_plugins.view.frames import Frame, Layer, Look, layers_of
from crossgrad_plugins.view.sources import Source, frame_of

SAME = Similarity(np.zeros(3), 1.0)
CAMERA = Camera(8, 4, 5.0, 5.0, 4.0, 2.0, torch.eye(4, dtype=torch.float64))
PHOTO = torch.full((4, 8, 3), 200, dtype=torch.uint8)
VIEW = View("a.jpg", CAMERA, SimpleNamespace(image=lambda: PHOTO), "all", np.zeros(0, np.int64))


def source(value, views=None, exposed=None):
    def draw(camera, outputs):
        alpha = torch.full((camera.height, camera.width), 0.5)
        alpha[0] = 0.0
        depth = alpha * torch.arange(1.0, camera.width + 1) if "depth" in outputs else None
        image = torch.full((camera.height, camera.width, 3), value)
        return SimpleNamespace(image=image, alpha=alpha, depth=depth)

    return Source("", SAME, draw, exposed, views or {})


def pixels(sources, look, view=VIEW):
    return Frame(sources, SAME, Fit(CAMERA, 10, 4, left=1), view, look).pixels()


def look(left, right=("photo", 0), **choices):
    return Look(Layer(*left), Layer(*right), **choices)


def test_the_left_layer_ends_at_the_split_line():
    frame = pixels([source(1.0)], look(("render", 0), split=0.5))
    assert frame[:, 0].max() == 0 and frame[:, 9].max() == 0
    assert (frame[:, 1:5] == 255).all()
    assert (frame[:, 6:9] == 200).all()


def test_two_sources_are_shown_left_and_right():
    looks = look(("render", 0), ("render", 1), split=0.5)
    frame = pixels([source(0.2), source(0.4)], looks, view=None)
    assert frame[0, 1, 0] == 51 and frame[0, 8, 0] == 102


def test_the_exposure_of_the_photo_can_be_left_out():
    exposed = source(0.4, {"a.jpg": VIEW}, lambda view, image: image / 2)
    for exposure, expected in ((True, 51), (False, 102)):
        frame = pixels([exposed], look(("render", 0), exposure=exposure))
        assert frame[0, 1, 0] == expected
    # A free camera has no exposure.
    assert pixels([exposed], look(("render", 0)), view=None)[0, 1, 0] == 102


def test_a_free_camera_shows_the_render_instead_of_photo_and_error():
    for kind in ("photo", "error"):
        assert pixels([source(0.4)], look((kind, 0)), view=None)[0, 1, 0] == 102


def test_the_error_of_an_equal_render_is_black():
    error = pixels([source(200 / 255)], look(("error", 0)))
    assert error.max() <= 4
    assert pixels([source(0.0)], look(("error", 0)))[:, 1:9].max() > 200


def test_near_and_far_depths_differ_and_nothing_is_black():
    frame = pixels([source(0.4)], look(("depth", 0)))
    assert frame[0].max() == 0
    assert frame[1, 1, 0] > frame[1, 1, 2] and frame[1, 8, 2] > frame[1, 8, 0]


def test_the_layers_of_the_page_have_letters_for_two_runs():
    runs = [source(0.1, {"a.jpg": VIEW}), source(0.2)]
    labels = [layer.label(2) for layer in layers_of(runs)]
    assert labels == ["render A", "render B", "photo", "error A", "error B", "depth A", "depth B"]
    assert [layer.label(1) for layer in layers_of([source(0.1)])] == ["render", "depth"]
    scene = Source("", SAME, views={"a.jpg": VIEW})
    assert [layer.kind for layer in layers_of([scene])] == ["photo", "points"]
    assert (pixels([scene], look(("photo", 0)))[:, 1:9] == 200).all()
    assert pixels([scene], look(("photo", 0)), view=None).max() == 0


@pytest.mark.parametrize("number", [0, 1, 100])
def test_the_frame_of_a_file_has_about_unit_size(number):
    means = np.random.default_rng(0).uniform(-1.0, 1.0, (number, 3)) * 50.0 + 1e6
    local = frame_of(means).to_local(means)
    assert np.isfinite(local).all() and np.abs(local).max(initial=0.0) < 2.0
