"""Scenes that benchmarks/towns.py makes: photos, poses and points that agree."""

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from support.scripts import BENCHMARKS

from crossgrad_core.scene.pycolmap_guard import guard_pycolmap


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A folder with a scene of nine photos from the air and nine of the street; its model."""
    folder = tmp_path_factory.mktemp("towns") / "town"
    # To compile the kernels takes longer than so few rays.
    plain = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    few = ["--aerial", "9", "--street", "9", "--width", "16"]
    script = [sys.executable, str(BENCHMARKS / "towns.py"), "--seed", "9", "--out", str(folder)]
    subprocess.run([*script, *few], check=True, env=plain, cwd=BENCHMARKS)
    guard_pycolmap()
    import pycolmap

    return folder, pycolmap.Reconstruction(str(folder / "sparse" / "0"))


@pytest.mark.slow
def test_points_are_at_the_positions_that_photos_show(town):
    folder, model = town
    assert len(model.images) == 18
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    apart, by_lot = [], []
    for image in model.images.values():
        seen = [each for each in image.points2D if each.has_point3D()]
        if image.name.endswith(("0000.jpg", "0008.jpg")):  # Held out.
            assert not seen
        photo = np.asarray(Image.open(folder / "images" / image.name), float)
        points = [model.points3D[each.point3D_id] for each in seen]
        for point, place in zip(points, seen, strict=True):
            at = image.project_point(point.xyz)
            # 2 cm of a point and a quarter of a pixel of its place, and few pixels to a metre.
            assert at is not None and np.abs(at - place.xy).max() < 2
            column, row = np.clip(place.xy.astype(int), 0, (15, 9))
            apart.append(np.abs(photo[row, column] - point.color).mean())
            by_lot.append(np.abs(photo[row, column] - points[0].color).mean())
    assert len(apart) > 2 * len(model.points3D)
    assert np.mean(apart) < 0.7 * np.mean(by_lot)


@pytest.mark.slow
def test_drone_photos_look_down_from_above_and_street_photos_along_the_street(town):
    _, model = town
    for image in model.images.values():
        low, high = (60, 115) if image.name.startswith("aerial/") else (1.6, 2.2)
        assert low <= image.projection_center()[2] <= high
        assert (image.viewing_direction()[2] < -0.5) == (low == 60)
