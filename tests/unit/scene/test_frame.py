import numpy as np
import pytest

from crossgrad_core.scene.frame import camera_centers, make_frame

RNG = np.random.default_rng(3)
CENTERS = RNG.normal(size=(20, 3)) * [30, 20, 5]
POINTS = RNG.normal(size=(2000, 3)) * [60, 60, 8]


def test_the_unit_of_length_is_the_extent_of_the_training_cameras():
    centers = np.array([[1.0, 0, 0], [3.0, 0, 0], [2.0, 2, 0], [2.0, -2, 0]])
    frame = make_frame(centers, POINTS)
    np.testing.assert_allclose(frame.similarity.offset, [2, 0, 0])
    assert 1 / frame.similarity.scale == pytest.approx(1.1 * 2)


def test_points_are_recovered_through_the_similarity():
    frame = make_frame(CENTERS, POINTS)
    back = frame.similarity.to_input(frame.points(POINTS))
    extent = 1 / frame.similarity.scale
    np.testing.assert_allclose(back, POINTS, rtol=0, atol=extent * 2.0**-31 * 1.01)


@pytest.mark.parametrize("factor", [1000.0, 0.001, 7.3e-5])
def test_scaling_the_input_changes_almost_no_bit(factor):
    reference = make_frame(CENTERS, POINTS).points(POINTS)
    scaled = make_frame(CENTERS * factor, POINTS * factor).points(POINTS * factor)
    assert np.mean(scaled == reference) > 0.999
    np.testing.assert_allclose(scaled, reference, rtol=0, atol=2.0**-30)


def moved_pose(pose, move):
    """The pose of the same camera in a scene that was moved, as COLMAP would write it."""
    moved = pose.copy()
    moved[:3, 3] = -pose[:3, :3] @ (camera_centers(pose[None])[0] + move)
    return moved


@pytest.mark.parametrize("seed", range(40))
def test_a_scene_moved_by_a_million_units_is_the_same_to_2e_9(seed):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(12, 3, 3)))[0]
    poses[:, :3, 3] = rng.normal(size=(12, 3)) * rng.uniform(0.1, 1.0, 3)
    # An extent of 1 to 10^4 units; points as far as ten times that.
    poses[:, :3, 3] *= 10 ** rng.uniform(0, 4) / (1.1 * np.abs(camera_centers(poses)).max())
    points = rng.normal(size=(500, 3)) * 3 * np.abs(camera_centers(poses)).max()
    move = rng.uniform(-1e6, 1e6, 3)
    there = np.stack([moved_pose(pose, move) for pose in poses])
    frame = make_frame(camera_centers(poses), points)
    far = make_frame(camera_centers(there), points + move)
    assert 1 / frame.similarity.scale >= 0.9
    assert np.abs(far.points(points + move) - frame.points(points)).max() <= 2e-9
    for pose, same in zip(poses, there, strict=True):
        local, moved = (each[None] for each in (frame.pose(pose), far.pose(same)))
        assert np.abs(camera_centers(moved) - camera_centers(local)).max() <= 2e-9
        np.testing.assert_array_equal(moved[0, :3, :3], local[0, :3, :3])


@pytest.mark.parametrize("spread", [0.0, 1e-9])
def test_cameras_at_one_position_use_the_distance_to_the_points_as_unit(spread):
    centers = np.array([4e6, 5e5, 100]) + spread * CENTERS
    points = centers[0] + 7 * POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    frame = make_frame(centers, points)
    assert 1 / frame.similarity.scale == pytest.approx(7, rel=1e-6)
    assert "median distance to the SfM points" in frame.note


def test_one_camera_without_points_keeps_the_unit_of_the_input():
    frame = make_frame(CENTERS[:1], np.zeros((0, 3)))
    assert frame.similarity.scale == 1
    np.testing.assert_array_equal(frame.similarity.offset, CENTERS[0])


def test_a_pose_keeps_its_rotation_and_its_centre_is_transformed():
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    pose[:3, 3] = [1, 2, 3]
    frame = make_frame(CENTERS, POINTS)
    local = frame.pose(pose)
    np.testing.assert_array_equal(local[:3, :3], pose[:3, :3])
    center = camera_centers(pose[None])
    np.testing.assert_allclose(
        camera_centers(local[None]), frame.similarity.to_local(center), atol=2.0**-30
    )


@pytest.mark.parametrize("strays", [1, 2])
def test_cameras_far_from_all_other_cameras_do_not_determine_the_unit(strays):
    far = CENTERS[:strays] + np.array([1e6, 0, 0])
    frame = make_frame(np.vstack([CENTERS, far]), POINTS)
    alone = make_frame(CENTERS, POINTS)
    np.testing.assert_array_equal(np.flatnonzero(frame.stray), 20 + np.arange(strays))
    assert frame.similarity.scale == alone.similarity.scale
    np.testing.assert_array_equal(frame.similarity.offset, alone.similarity.offset)


@pytest.mark.parametrize(
    ("near", "far", "distance"), [(16, 1, 8), (97, 3, 8), (10, 10, 1000), (3, 1, 1e6), (18, 4, 90)]
)
def test_distant_groups_and_few_cameras_are_not_outliers(near, far, distance):
    rng = np.random.default_rng(0)
    centers = np.vstack([rng.normal(size=(near, 3)), rng.normal(size=(far, 3)) + distance])
    assert not make_frame(centers, rng.normal(size=(500, 3))).stray.any()


def test_a_camera_that_sees_a_large_scene_from_afar_is_not_an_outlier():
    street = RNG.normal(size=(30, 3)) * 0.5
    drone = np.array([[0.0, 0, 100]])
    town = RNG.uniform(-80, 80, (2000, 3))
    assert not make_frame(np.vstack([street, drone]), town).stray.any()


def test_single_far_points_do_not_hide_an_outlier_camera():
    points = np.vstack([POINTS, [[1e9, 0, 0]]])
    assert make_frame(np.vstack([CENTERS, [[1e6, 0, 0]]]), points).stray.sum() == 1
