"""Cameras of a browser window: poses, fits of photos, the upward direction, recorded paths."""

from dataclasses import replace
from math import isclose, radians, tan
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from crossgrad_core.contract.scene import Camera, Similarity, View
from crossgrad_plugins.view.camera_file import camera_path
from crossgrad_plugins.view.cameras import (
    MOST_PIXELS,
    camera_of,
    fov_in_window,
    free_camera,
    looks_like,
    moved,
    photo_in_window,
    quaternion_of,
    whole_window,
)
from crossgrad_plugins.view.training import Training


def camera(rows, center=(0.0, 0.0, 0.0), size=(300, 200)):
    """A camera with the given right, down and forward axes."""
    pose = np.eye(4)
    pose[:3, :3] = rows
    pose[:3, 3] = -pose[:3, :3] @ np.array(center)
    return Camera(*size, 250.0, 240.0, size[0] / 2, size[1] / 2, torch.from_numpy(pose))


def view(camera):
    return View("a.jpg", camera, None, "all", np.zeros(0, dtype=np.int64))


DOWN = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]  # looks down, north is the upper side of the image
LEVEL = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]  # looks west


def test_a_window_gives_the_camera_that_it_shows():
    there = camera(LEVEL, (1.0, 2.0, 3.0))
    window = SimpleNamespace(
        wxyz=2.0 * quaternion_of(there), position=np.array([1.0, 2.0, 3.0]), fov=radians(60.0),
        image_width=640, image_height=480,
    )  # fmt: skip
    found = camera_of(window)
    torch.testing.assert_close(found.world_to_camera, there.world_to_camera)
    assert isclose(found.fx, 240 / tan(radians(30.0)))
    assert looks_like(found, view(there))
    assert not looks_like(found, view(camera(LEVEL, (1.0, 2.0, 3.01))))
    assert camera_of(SimpleNamespace(**{**vars(window), "position": np.full(3, np.nan)})) is None


@pytest.mark.parametrize("size", [(640, 200), (200, 640), (300, 200)])
def test_a_photo_is_shown_whole_in_its_own_size(size):
    window, photo = replace(free_camera(), width=size[0], height=size[1]), camera(LEVEL)
    fit = photo_in_window(window, photo)
    assert fit.camera is photo
    assert (fit.width, fit.height) >= (300, 200)
    assert isclose(fit.width / fit.height, size[0] / size[1], rel_tol=0.01)
    assert fit.left == (fit.width - 300) // 2 and fit.top == (fit.height - 200) // 2
    # The window's own field of view shows the photo's pixels at the same angles.
    assert isclose(fit.height / 2 / tan(fov_in_window(window, photo) / 2), photo.fy)


def test_a_large_window_gets_fewer_pixels():
    fit = whole_window(replace(free_camera(), width=8000, height=4000), 1.0)
    assert fit.width * fit.height <= MOST_PIXELS * 1.01
    assert isclose(fit.width / fit.height, 2.0, rel_tol=0.01)


def test_a_camera_moves_between_the_frames_of_two_runs():
    first = Similarity(np.array([100.0, 0.0, 0.0]), 0.5)
    second = Similarity(np.array([90.0, 1.0, 0.0]), 2.0)
    there = moved(camera(LEVEL, (1.0, 2.0, 3.0)), first, second)
    expected = second.to_local(first.to_input(np.array([[1.0, 2.0, 3.0]])))[0]
    np.testing.assert_allclose(there.center.numpy(), expected)
    assert moved(there, second, second) is there


def test_a_path_goes_through_its_keyframes_at_even_sizes():
    keys = [camera(LEVEL, (x, x * x, 0.0), size=(301, 201)) for x in (0.0, 1.0, 2.0)]
    path = camera_path(keys, Similarity(np.array([5.0, 0.0, 0.0]), 2.0))
    assert (path["render_width"], path["render_height"]) == (300, 200)
    places = [np.reshape(f["camera_to_world"], (4, 4))[:3, 3] for f in path["camera_path"]]
    np.testing.assert_allclose(places[::48], [[5, 0, 0], [5.5, 0.5, 0], [6, 2, 0]], atol=1e-12)


def test_a_long_curve_is_thinned_and_keeps_its_range():
    training = Training()
    for step in range(1, 10_001):
        training.add_loss(step, 1.0 / step)
    steps, losses = Training.curve(training.losses)
    assert 100 < len(steps) <= 401
    assert steps[0] < 100 and steps[-1] > 9_900
    assert (np.diff(losses) < 0).all()
