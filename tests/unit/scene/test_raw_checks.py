"""Invalid data of a reader is refused or left out before anything is computed with it."""

import numpy as np
import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.frame import camera_centers, make_frame
from crossgrad_core.scene.raw import RawScene, RawView, check_distances, check_points, check_views

CAMERA = Calibration("PINHOLE", 48, 32, (50.0, 50.0, 24.0, 16.0))
POINTS = np.arange(12.0).reshape(4, 3)


def raw(names=("a.jpg", "b.jpg"), shifts=((0, 0, 0), (1, 0, 0)), points=POINTS, camera=CAMERA):
    views = []
    for name, shift in zip(names, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, 3] = shift
        views.append(RawView(name, camera, pose, np.arange(len(points))))
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    return RawScene("scene", "scene/images", tuple(views), np.array(points, float), colors)


def refused(check, *words):
    with pytest.raises(UserError) as caught:
        check()
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert caught.value.where
    assert caught.value.todo


@pytest.mark.parametrize(
    "name", ["", ".", "..", "/a.jpg", "../a.jpg", "x/../a.jpg", "\udcff.jpg", "a\n.jpg",
             "\x1b[2J.jpg", "a" * 256, "ä" * 128, "a\0.jpg", "a/" * 600 + "b.jpg", "C:/a.jpg"],
)  # fmt: skip
def test_image_names_outside_the_photo_folder_are_refused(name):
    refused(lambda: check_views(raw(("b.jpg", name))), "an image name")


@pytest.mark.parametrize(
    "name", ["größe.jpg", "写真\u3000一.jpg", "a b.jpg", "x/y/z.jpg", "..a.jpg"]
)
def test_names_in_any_language_are_accepted(name):
    check_views(raw(("b.jpg", name)))


def test_two_spellings_of_one_path_count_as_one_name():
    refused(
        lambda: check_views(raw(("x/a.jpg", "x//a.jpg"))), "several images of the model", "x/a.jpg"
    )


@pytest.mark.parametrize("shift", [np.nan, np.inf, 1e31, -1e300])
def test_positions_whose_square_overflows_are_refused(shift):
    refused(lambda: check_views(raw(shifts=((0, 0, 0), (0, shift, 0)))), "not finite")


@pytest.mark.parametrize(
    ("size", "params", "words"),
    [
        ((2**63, 32), CAMERA.params, "zero or too large"),
        ((48, 32), (1e-9, 50.0, 24.0, 16.0), "focal length"),
        ((48, 32), (50.0, 50.0, 1e300, 16.0), "camera parameter"),
        ((48, 32), (50.0, np.nan, 24.0, 16.0), "camera parameter"),
    ],
)
def test_cameras_beyond_single_precision_are_refused(size, params, words):
    camera = Calibration("PINHOLE", *size, params)
    refused(lambda: check_views(raw(camera=camera)), words)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_non_finite_points_are_left_out(value):
    points = POINTS.copy()
    points[1, 2] = value
    checked, notes = check_points(raw(points=points))
    assert len(checked.xyz) == 3
    assert "1 point left out" in notes[0]


def test_points_too_far_for_single_precision_are_left_out():
    points = POINTS.copy()
    points[1] = 1e25
    scene = raw(points=points)
    checked, _ = check_points(scene)
    frame = make_frame(camera_centers(np.stack([v.world_to_camera for v in scene.views])), POINTS)
    kept, notes = check_distances(scene, checked, frame)
    np.testing.assert_array_equal(kept.xyz, POINTS[[0, 2, 3]])
    assert kept.rows(np.array([0, 1, 3])).tolist() == [0, 2]
    assert "1 point left out" in notes[0]


def test_a_camera_too_far_for_single_precision_is_refused():
    scene = raw(shifts=((0, 0, 0), (1e25, 0, 0)))
    checked, _ = check_points(scene)
    frame = make_frame(np.array([[0.0, 0, 0], [1.0, 0, 0]]), POINTS)
    refused(lambda: check_distances(scene, checked, frame), "too far", "b.jpg")


def test_a_scene_with_nearly_equal_camera_positions_has_a_finite_scale():
    frame = make_frame(np.array([[0.0, 0, 0], [1e-310, 0, 0]]), np.zeros((0, 3)))
    assert frame.similarity.scale == 1.0
