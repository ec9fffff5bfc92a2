"""Points that no photo shows are refused, with the mistake in the poses that explains it."""

import numpy as np
import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.point_cloud import PointCloud
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.raw import RawView

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def views(change):
    """Six cameras on a ring of radius 4 that look at the origin, their poses changed."""
    lens = Calibration("PINHOLE", 100, 80, (90.0, 90.0, 50.0, 40.0))
    found = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False):
        center = 4.0 * np.array([np.cos(angle), np.sin(angle), 0.3])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ center
        none = np.zeros(0, np.int64)
        found.append(RawView(f"{len(found)}.png", lens, change(pose), none))
    return found


@pytest.fixture
def points():
    positions = np.random.default_rng(0).uniform([-0.5, 0.2, 0.6], [0.5, 0.8, 1.2], (200, 3))
    return PointCloud(positions, np.zeros((200, 3), np.uint8), "points.ply")


def test_points_visible_in_photos_are_accepted(points):
    check_seen(points, views(lambda pose: pose), "poses.json")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda pose: FLIP @ pose, "OpenGL"),
        (np.linalg.inv, "inverted"),
        (lambda pose: FLIP @ np.linalg.inv(FLIP @ pose), "inverted"),
        (lambda pose: FLIP @ np.linalg.inv(pose), "inverted"),
    ],
)
def test_a_known_mistake_in_the_poses_is_named(points, change, cause):
    with pytest.raises(UserError, match="no photo shows the SfM points") as caught:
        check_seen(points, views(change), "poses.json")
    assert cause in caught.value.what and "correct the poses" in caught.value.todo


def test_points_in_another_frame_are_distinguished_from_mistakes_in_the_poses(points):
    far = PointCloud(points.positions + 1000.0, points.colors, points.source)
    with pytest.raises(UserError, match="another coordinate system than the cameras"):
        check_seen(far, views(lambda pose: pose), "poses.json")
