"""Fold-over of distortion models, and pixels that undistortion to a pinhole loses."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image

from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.photo_notes import note_undistortion
from crossgrad_core.scene.photos.photos import PhotoSource

WIDTH, HEIGHT = 160, 120
#: Model, parameters behind the focal length and the principal point, and the fold's radius at
#: distance 1, worked out by hand.
FOLDS = [
    ("SIMPLE_RADIAL", (110,), (-0.35,), (3 * 0.35) ** -0.5),
    ("SIMPLE_RADIAL", (110,), (-2.0,), 6.0**-0.5),
    ("RADIAL", (110,), (-0.5, 0.05), ((1.5 - 1.25**0.5) / 0.5) ** 0.5),
    ("RADIAL", (110,), (0.2, -0.6), ((0.6 + 12.36**0.5) / 6.0) ** 0.5),
    ("OPENCV", (110, 110), (-0.35, 0.0, 0.0, 0.0), (3 * 0.35) ** -0.5),
    ("FULL_OPENCV", (110, 110), (-1.0, 0, 0, 0, 0, 0, 0, 0), 3.0**-0.5),
    ("SIMPLE_RADIAL_FISHEYE", (80,), (-0.3,), np.tan(0.9**-0.5)),
    ("RADIAL_FISHEYE", (80,), (-0.3, 0.0), np.tan(0.9**-0.5)),
    ("OPENCV_FISHEYE", (80, 80), (-0.3, 0.0, 0.0, 0.0), np.tan(0.9**-0.5)),
    ("THIN_PRISM_FISHEYE", (80, 80), (-0.3, 0, 0, 0, 0, 0, 0, 0), np.tan(0.9**-0.5)),
    ("RAD_TAN_THIN_PRISM_FISHEYE", (80, 80), (-0.3, *[0] * 11), np.tan(0.9**-0.5)),
]
#: Lenses that have a ray for every pixel of the photo, below 90 degrees.
SOUND = [
    ("SIMPLE_RADIAL", (150,), (-0.1,)),
    ("SIMPLE_RADIAL", (150,), (0.3,)),
    ("RADIAL", (150,), (-0.2, 0.05)),
    ("OPENCV", (150, 151), (-0.2, 0.06, 0.001, -0.002)),
    ("FULL_OPENCV", (150, 151), (0.1, 0.02, 0.001, 0.001, 0, 0.2, 0, 0)),
    ("OPENCV_FISHEYE", (100, 100), (-0.02, 0.01, 0.0, 0.0)),
    ("FOV", (110, 110), (0.9,)),
    ("SIMPLE_DIVISION", (150,), (-0.2,)),
    ("SIMPLE_DIVISION", (150,), (0.2,)),
    ("EUCM", (150, 150), (0.6, 1.1)),
    ("SIMPLE_FISHEYE", (110,), ()),
]


def lens(model: str, focal: tuple[float, ...], extra: tuple[float, ...]) -> Calibration:
    params = (*focal, WIDTH / 2, HEIGHT / 2, *extra)
    return Calibration(model, WIDTH, HEIGHT, tuple(map(float, params)))


def radii(calibration: Calibration) -> NDArray[np.float64]:
    """[H, W] distance of the rays of undistorted pixels from the axis, at distance 1."""
    frame = calibration.pinhole
    x = (np.arange(frame.width) + 0.5 - frame.cx) / frame.fx
    y = (np.arange(frame.height) + 0.5 - frame.cy) / frame.fy
    return np.hypot(x, y[:, None])


@pytest.mark.parametrize(("model", "focal", "extra", "fold"), FOLDS)
def test_pixels_beyond_the_fold_do_not_count(
    model: str, focal: tuple[float, ...], extra: tuple[float, ...], fold: float
) -> None:
    calibration = lens(model, focal, extra)
    counted, radius = calibration.reached(), radii(calibration)
    assert not calibration.fills_frame
    assert not counted[radius >= fold].any()
    # All but the last pixel of the photo before the fold, which many undistorted pixels share.
    camera = calibration._camera
    rim = camera.img_from_cam(np.array([[fold, 0.0, 1.0]]))[0, 0] - WIDTH / 2
    steps = np.linspace(0.0, fold, 2000)
    rays = np.stack([steps, np.zeros_like(steps), np.ones_like(steps)], 1)
    before = steps[camera.img_from_cam(rays)[:, 0] - WIDTH / 2 < rim - 2.0][-1]
    shown = calibration.undistort(np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)) == 255
    assert counted[(radius < before) & shown].all()


@pytest.mark.parametrize(("model", "focal", "extra"), SOUND)
def test_ordinary_lenses_lose_no_pixel_and_have_the_same_frame_as_in_pycolmap(
    model: str, focal: tuple[float, ...], extra: tuple[float, ...]
) -> None:
    calibration = lens(model, focal, extra)
    frame = calibration.pinhole
    camera = pycolmap.undistort_camera(
        pycolmap.UndistortCameraOptions(),
        pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=calibration.params),
    )
    assert (frame.width, frame.height) == (camera.width, camera.height)
    assert [frame.fx, frame.fy, frame.cx, frame.cy] == camera.params.tolist()
    assert calibration.cost is not None
    assert calibration.cost.beyond == 0.0
    assert calibration.cost.kept == pytest.approx(calibration.cost.seen, abs=7.0)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("seed", range(12))
def test_the_distorted_radius_increases_from_the_centre_to_every_counted_pixel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    extra = (rng.uniform(-0.6, 0.3), rng.uniform(-0.2, 0.2), *rng.uniform(-0.04, 0.04, 2))
    calibration = lens(("OPENCV", "OPENCV_FISHEYE")[seed % 2], (100, 105), extra)
    frame, counted = calibration.pinhole, calibration.reached()
    rows, columns = np.nonzero(counted)
    ends = np.stack([(columns + 0.5 - frame.cx) / frame.fx, (rows + 0.5 - frame.cy) / frame.fy], 1)
    steps = np.linspace(0.0, 1.0, 100)[:, None, None]
    rays = np.concatenate([steps * ends, np.ones((100, len(ends), 1))], 2).reshape(-1, 3)
    pixels = calibration._camera.img_from_cam(rays).reshape(100, -1, 2)
    radius = np.linalg.norm((pixels - pixels[0]) / [100, 105], axis=2)
    assert (np.diff(radius, axis=0) > 0.0).all()
    inside = (pixels[-1] >= 0.0) & (pixels[-1] <= [WIDTH, HEIGHT])
    assert inside.all()


def test_tangential_terms_alone_can_fold() -> None:
    calibration = lens("OPENCV", (60, 60), (0.0, 0.0, 0.0, -0.15))
    counted = calibration.reached()
    frame = calibration.pinhole
    assert not calibration.fills_frame or frame.width < WIDTH
    right = counted[frame.height // 2, int(frame.cx) :]
    # x + 3 p2 x^2 stops growing at 1 / (6 * 0.15).
    assert right.sum() <= 60 / (6 * 0.15)


def test_the_loss_of_undistortion_is_reported_for_a_fisheye_of_190_degrees() -> None:
    calibration = lens("OPENCV_FISHEYE", (48, 48), (0.0, 0.0, 0.0, 0.0))
    cost = calibration.cost
    assert cost is not None
    assert cost.seen == pytest.approx(2 * np.rad2deg(80 / 48), abs=1.0)
    assert cost.kept == pytest.approx(2 * np.rad2deg(np.arctan(80 / 48)), abs=1.0)
    frame = calibration.pinhole
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    angle = np.hypot(x - 80, y - 60) / 48
    scale = np.tan(np.minimum(angle, 1.5)) / np.maximum(angle, 1e-9)
    shown = (angle < 1.5) & (np.abs((x - 80) * scale) < frame.width / 2)
    shown &= np.abs((y - 60) * scale) < frame.height / 2
    assert cost.lost == pytest.approx(1.0 - shown.mean(), abs=0.01)
    notes = note_undistortion({"a.png": source(Path("a.png"), calibration)})
    assert any(
        "1 photo has a field of view of 191 degrees; undistortion keeps 118 degrees and loses 62 %"
        in note
        for note in notes
    )


@pytest.mark.parametrize(
    ("model", "focal", "extra"),
    [("FOV", (48, 48), (1.2,)), ("SIMPLE_DIVISION", (110,), (-2.9,))],
)
def test_lenses_of_180_degrees_and_more_do_not_shrink_to_a_few_pixels(
    model: str, focal: tuple[float, ...], extra: tuple[float, ...]
) -> None:
    frame = lens(model, focal, extra).pinhole
    assert (frame.width, frame.height) == (WIDTH, HEIGHT)


def test_a_decoded_photo_is_masked_beyond_the_fold_and_a_note_counts_the_pixels(
    tmp_path: Path,
) -> None:
    calibration = lens("SIMPLE_RADIAL", (110,), (-0.35,))
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    distorted = np.hypot(x - 80, y - 60) / 110
    radius = np.linspace(0.0, (3 * 0.35) ** -0.5, 10_000)
    has_ray = distorted < radius[-1] * (1 - 0.35 * radius[-1] ** 2)
    Image.fromarray(np.where(has_ray, 40, 255).astype(np.uint8)).save(tmp_path / "a.png")
    photo = source(tmp_path / "a.png", calibration)
    assert photo.may_mask
    image, mask = photo.decode()
    assert mask is not None
    assert (image[mask] == 40).all()
    share = 100.0 * (1.0 - mask.numpy().mean())
    note = next(n for n in note_undistortion({"a.png": photo}) if "not invertible" in n)
    assert "SIMPLE_RADIAL" in note
    assert f"{share:.0f} % of the undistorted pixels" in note


def source(path: Path, calibration: Calibration) -> PhotoSource:
    frame = calibration.pinhole
    return PhotoSource(
        path=path,
        width=WIDTH,
        height=HEIGHT,
        orientation=1,
        mask=None,
        alpha=False,
        background=None,
        distorted=calibration,
        target=(frame.width, frame.height),
    )
