import numpy as np
import pytest
import torch

from crossgrad_core.contract.scene import Camera
from crossgrad_core.scene.build import label_by_folder, label_by_footprint

NONE = np.zeros(0, dtype=np.int64)


def camera(height, focal=100.0):
    """Looks straight down at the plane z = 0 from a height."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[1, 1] = pose[2, 2] = -1
    pose[2, 3] = height
    return Camera(100, 100, focal, focal, 50.0, 50.0, pose)


def plane(count=50):
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (count, 3))
    points[:, 2] = 0
    return points


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        (["a.jpg", "b.jpg"], None),
        (["x/a.jpg", "x/b.jpg"], None),
        (["x/a.jpg", "y/a.jpg"], ("x", "y")),
        (["a.jpg", "y/a.jpg"], ("images", "y")),
        (["x/1/a.jpg", "x/2/a.jpg", "y/1/a.jpg"], ("x", "x", "y")),
        (["all/x/a.jpg", "all/y/a.jpg", "all/c.jpg"], ("x", "y", "images")),
    ],
)
def test_labels_are_taken_from_folder_names(names, labels):
    assert label_by_folder(names) == labels


def test_views_up_to_the_median_footprint_of_the_training_views_are_near():
    cameras = [camera(h) for h in (1.0, 2.0, 3.0, 9.0)]
    seen = [np.arange(50)] * 4
    assert label_by_footprint(cameras, seen, plane(), [0, 1, 3]) == ("near", "near", "far", "far")


def test_a_distant_view_with_a_long_lens_is_near():
    cameras = [camera(2.0, 100.0), camera(8.0, 800.0)]
    assert label_by_footprint(cameras, [np.arange(50)] * 2, plane(), [0, 1]) == ("far", "near")


def test_a_view_without_observations_uses_the_points_in_its_frustum():
    cameras = [camera(1.0), camera(9.0), camera(1.5), camera(8.0)]
    behind = np.array([[0.0, 0, 100], [0, 0, 200], [0, 0, 300]])
    seen = [np.arange(50), np.arange(50), NONE, np.arange(2)]
    points = np.concatenate([plane(), behind])
    assert label_by_footprint(cameras, seen, points, [0, 1]) == ("near", "far", "near", "far")


def test_a_view_without_visible_points_gets_the_label_of_the_nearest_camera():
    away = camera(8.5)
    away.world_to_camera[1:3] *= -1
    cameras = [camera(1.0), camera(9.0), away]
    seen = [np.arange(50), np.arange(50), NONE]
    assert label_by_footprint(cameras, seen, plane(), [0, 1]) == ("near", "far", "far")


def test_a_scene_without_points_has_one_regime():
    cameras = [camera(1.0), camera(9.0)]
    assert label_by_footprint(cameras, [NONE] * 2, np.zeros((0, 3)), [0, 1]) == ("all", "all")
