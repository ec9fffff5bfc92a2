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
        (Calibration("FOO", 96, 64, (1.0,)), "unknown camera model"),
        (Calibration("PINHOLE", 96, 64, (1.0, 1.0)), "wrong number of parameters"),
        (Calibration("PINHOLE", 0, 64, (1.0, 1.0, 1.0, 1.0)), "has no pixels"),
        (Calibration("PINHOLE", 96, 64, (0.0, 1.0, 1.0, 1.0)), "focal length is not positive"),
        (Calibration("PINHOLE", 96, 64, (1.0, -5.0, 1.0, 1.0)), "focal length is not positive"),
        (Calibration("PINHOLE", 96, 64, (math.nan, 1.0, 1.0, 1.0)), "not a finite number"),
        (Calibration("PINHOLE", 96, 64, (1.0, 1.0, math.inf, 1.0)), "not a finite number"),
    ],
)
def test_impossible_cameras_are_refused(calibration, message):
    with pytest.raises(UserError, match=rf"{message}(?s:.*)here"):
        calibration.check("here")


def test_pinholes_are_taken_as_they_are():
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
def test_models_without_distortion_are_pinholes(model, params, pinhole):
    assert Calibration(model, 96, 64, params).is_pinhole == pinhole


def test_a_spherical_camera_has_no_pinhole():
    sphere = Calibration("EQUIRECTANGULAR", 96, 64, (96.0, 64.0))
    with pytest.raises(UserError, match="EQUIRECTANGULAR cannot be undistorted"):
        _ = sphere.pinhole
    with pytest.raises(UserError, match=r"EQUIRECTANGULAR cannot(?s:.*)here(?s:.*)to do: .*360"):
        sphere.check("here")


# Coefficients of r^2, r^4 ... in the radius on the photo over r, or over the angle of a fisheye.
FOLDED = [
    ("SIMPLE_RADIAL", (1500.0, 2000.0, 1500.0, -0.3), (-0.3,)),
    ("SIMPLE_RADIAL", (300.0, 1500.0, 1200.0, -0.02), (-0.02,)),
    ("RADIAL", (1500.0, 2000.0, 1500.0, -0.3, 0.01), (-0.3, 0.01)),
    ("OPENCV", (2500.0, 2400.0, 2000.0, 1500.0, -0.3, 0.02, 0.0, 0.0), (-0.3, 0.02)),
    ("FULL_OPENCV", (1500.0, 1500.0, 2e3, 1500.0, -0.3, 0, 0, 0, 0.01, 0, 0, 0), (-0.3, 0, 0.01)),
    ("OPENCV_FISHEYE", (1000.0, 1000.0, 2000.0, 1500.0, -0.25, 0.0, 0.0, 0.0), (-0.25,)),
]  # fmt: skip


@pytest.mark.parametrize(("model", "params", "terms"), FOLDED)
def test_a_lens_reaches_to_where_its_polynomial_turns_round(model, params, terms):
    lens = Calibration(model, 4000, 3000, params).resized(400, 300)
    # d/dr (r + k1 r^3 + ...) = 1 + 3 k1 r^2 + ...
    slope = np.polynomial.Polynomial([1.0, *((2 * n + 3) * k for n, k in enumerate(terms))])
    fold = math.sqrt(min(root.real for root in slope.roots() if root.real > 0 == root.imag))
    fold = math.tan(fold) if "FISHEYE" in model else fold
    frame = lens.pinhole
    cell = math.hypot(frame.width / frame.fx, frame.height / frame.fy) / 255
    assert lens.reach == pytest.approx(fold, abs=cell)
    assert not lens.fills_frame
    x = (np.arange(frame.width) + 0.5 - frame.cx) / frame.fx
    y = (np.arange(frame.height) + 0.5 - frame.cy) / frame.fy
    np.testing.assert_array_equal(lens.unfolded(), np.hypot(x, y[:, None]) < lens.reach)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (2800.0, 2000.0, 1500.0, -0.2)),  # folds beyond the frame
        ("RADIAL", (1500.0, 2000.0, 1500.0, -0.3, 0.05)),  # 0.9^2 < 4 * 0.25: no real root
        ("OPENCV", (2500.0, 2500.0, 2000.0, 1500.0, -0.08, 0.02, 1e-3, -1e-3)),
        ("OPENCV_FISHEYE", (1200.0, 1200.0, 2000.0, 1500.0, -0.1, 0.0, 0.0, 0.0)),
        ("FULL_OPENCV", (2000.0, 2000.0, 2000.0, 1500.0, -0.4, 0.1, 0, 0, 0.01, 0, 0, 0)),
        ("FOV", (3000.0, 3000.0, 2000.0, 1500.0, 0.9)),
        ("EUCM", (3000.0, 3000.0, 2000.0, 1500.0, 0.6, 1.0)),
        ("SIMPLE_DIVISION", (3000.0, 2000.0, 1500.0, -0.5)),
    ],
)
def test_a_lens_that_does_not_fold_reaches_everywhere(model, params):
    lens = Calibration(model, 4000, 3000, params).resized(400, 300)
    assert lens.reach == math.inf
    assert lens.fills_frame
    assert lens.unfolded().all()


def test_beyond_the_fold_a_photo_shows_what_it_has_shown():
    lens = Calibration("SIMPLE_RADIAL", 400, 300, (150.0, 200.0, 150.0, -0.3))
    ramp = np.broadcast_to(np.arange(400) // 2, (300, 400)).astype(np.uint8)
    row, shown = (
        values[round(lens.pinhole.cy)] for values in (lens.undistort(ramp), lens.unfolded())
    )
    steps = np.diff(row.astype(int))
    within = shown[1:] & shown[:-1]
    assert (steps[within] >= 0).all() and (steps[~within] < 0).any()


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
def test_blank_borders_are_known_without_undistorting(calibration, fills):
    white = np.full((calibration.height, calibration.width), 255, dtype=np.uint8)
    assert calibration.fills_frame == fills == (calibration.undistort(white).min() == 255)


def test_a_distorted_camera_is_scaled_with_its_photos():
    double = RADIAL.resized(192, 128)
    assert double.params == (220.0, 98.0, 62.0, -0.08)
