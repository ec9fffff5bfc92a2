import numpy as np
import pytest
from support.scenes import write_tiny_scene


def load(path):
    import pycolmap

    return pycolmap.Reconstruction(path / "sparse" / "0")


def test_writing_a_scene_twice_gives_equal_bytes(tmp_path):
    first, second = (
        write_tiny_scene(tmp_path / name, views=3, width=24, height=16) for name in "ab"
    )
    files = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert len(files) == 8
    for name in files:
        assert (first / name).read_bytes() == (second / name).read_bytes()
    other = write_tiny_scene(tmp_path / "c", views=3, width=24, height=16, seed=1)
    photo = "images/0000.png"
    assert (first / photo).read_bytes() != (other / photo).read_bytes()


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE"])
def test_tracks_of_a_written_scene_are_exact(model, tmp_path):
    scene = load(write_tiny_scene(tmp_path, model=model, text=True, scale=10, offset=(1e3, 0, 0)))
    scene.update_point_3d_errors()
    assert scene.num_points3D() == 200
    assert scene.compute_mean_reprojection_error() < 1e-9
    assert scene.compute_mean_track_length() > 3


def test_each_folder_of_a_tiny_scene_is_a_ring_at_three_times_the_previous_distance(tmp_path):
    scene = load(write_tiny_scene(tmp_path, views=4, folders=("near", "mid", "far"), mixed=True))
    distance = {}
    for image in scene.images.values():
        folder = image.name.split("/")[0]
        distance.setdefault(folder, []).append(np.linalg.norm(image.projection_center()))
    medians = [np.median(distance[folder]) for folder in ("near", "mid", "far")]
    assert medians[1] / medians[0] == pytest.approx(3, rel=0.2)
    assert medians[2] / medians[1] == pytest.approx(3, rel=0.2)
    assert {(c.width, c.height) for c in scene.cameras.values()} == {(48, 32), (36, 40)}
