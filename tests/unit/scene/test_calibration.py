import math
from dataclasses import astuple

import numpy as np
import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration

RADIAL = Calibration("SIMPLE_RADIAL", 96, 64, (110.0, 49.0, 31.0, -0.08))


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        (Calibration("FOO", 96, 64, (1.0,)), "camera model is unknown"),
        (Calibration("PINHOLE", 96, 64, (1.0, 1.0)), "wrong number of parameters"),
        (Calibration("PINHOLE", 0, 64, (1.0, 1.0, 1.0, 1.0)), "the image size of a camera is zero"),
        (
            Calibration("PINHOLE", 96, 64, (0.0, 1.0, 1.0, 1.0)),
            "focal length of a camera is not positive",
        ),
        (Calibration("EQUIRECTANGULAR", 96, 48, (96.0, 48.0)), "converted to a pinhole camera"),
        (
            Calibration("PINHOLE", 96, 64, (1.0, -5.0, 1.0, 1.0)),
            "focal length of a camera is not positive",
        ),
        (Calibration("PINHOLE", 96, 64, (math.nan, 1.0, 1.0, 1.0)), "not a finite number"),
        (Calibration("PINHOLE", 96, 64, (1.0, 1.0, math.inf, 1.0)), "not a finite number"),
    ],
)
def test_impossible_cameras_are_refused(calibration, message):
    with pytest.raises(UserError, match=rf"{message}(?s:.*)here"):
        calibration.check("here")


def test_pinhole_cameras_are_used_unchanged():
    simple = Calibration("SIMPLE_PINHOLE", 96, 64, (110.0, 40.0, 30.0))
    simple.check("here")
    assert simple.is_pinhole
    assert astuple(simple.pinhole) == (96, 64, 110.0, 110.0, 40.0, 30.0)
    half = simple.resized(48, 16)
    assert astuple(half.pinhole) == (48, 16, 55.0, 27.5, 20.0, 7.5)


@pytest.mark.parametrize(
    ("model", "params", "pinhole"),
    [
        ("SIMPLE_RADIAL", (110.0, 49.0, 31.0, 0.0), True),
        ("SIMPLE_RADIAL", (110.0, 49.0, 31.0, 1e-3), False),
        ("OPENCV", (110.0, 111.0, 49.0, 31.0, 0.0, 0.0, 0.0, 0.0), True),
        ("OPENCV_FISHEYE", (110.0, 111.0, 49.0, 31.0, 0.0, 0.0, 0.0, 0.0), False),
    ],
)
def test_models_with_zero_distortion_become_pinholes(model, params, pinhole):
    assert Calibration(model, 96, 64, params).is_pinhole == pinhole


def test_a_spherical_camera_has_no_pinhole():
    with pytest.raises(UserError, match="EQUIRECTANGULAR cannot be undistorted"):
        _ = Calibration("EQUIRECTANGULAR", 96, 64, (96.0, 64.0)).pinhole


def test_undistortion_agrees_with_the_camera_model():
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=96, height=64, params=RADIAL.params)
    ramp = np.broadcast_to(np.arange(96, dtype=np.uint8) * 2, (64, 96)).copy()
    warped = RADIAL.undistort(ramp)
    frame = RADIAL.pinhole
    assert warped.shape == (frame.height, frame.width)
    u = np.arange(frame.width) + 0.5
    rays = np.column_stack([(u - frame.cx) / frame.fx, np.full_like(u, 0.1), np.ones_like(u)])
    row = int(frame.cy + 0.1 * frame.fy)
    expected = 2 * (np.array(camera.img_from_cam(rays))[:, 0] - 0.5)
    assert np.abs(warped[row] - expected).max() < 1.1
    assert RADIAL.fills_frame


@pytest.mark.parametrize(
    ("calibration", "fills"),
    [
        (RADIAL, True),
        (Calibration("SIMPLE_RADIAL", 60, 40, (60.0, 0.0, 20.0, -0.1)), False),
        (Calibration("SIMPLE_RADIAL", 60, 40, (60.0, 30.0, 20.0, 500.0)), False),
        (Calibration("OPENCV_FISHEYE", 60, 40, (6.0, 6.0, 30.0, 20.0, 0.0, 0.0, 0.0, 0.0)), True),
    ],
)
def test_blank_borders_are_predicted_without_undistortion(calibration, fills):
    white = np.full((calibration.height, calibration.width), 255, dtype=np.uint8)
    assert calibration.fills_frame == fills == (calibration.undistort(white).min() == 255)


def test_a_distorted_camera_is_scaled_with_its_photos():
    double = RADIAL.resized(192, 128)
    assert double.params == (220.0, 98.0, 62.0, -0.08)
