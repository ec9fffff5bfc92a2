"""Models that nothing holds together are taken apart."""

import numpy as np
import pycolmap
import pytest

from crossgrad_plugins.prepare.mapping import sound_models


def model_of(tracks, photos):
    """A model of photos and of points that each of some photos sees, a hundred to a track."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 80, 60)
    )
    for number in range(1, photos + 1):
        keypoints = np.zeros((sum(count for count, _ in tracks), 2))
        image = pycolmap.Image(
            name=f"{number}.jpg", keypoints=keypoints, camera_id=1, image_id=number
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    at = 0
    for count, seen in tracks:
        for _ in range(count):
            elements = [pycolmap.TrackElement(number, at) for number in seen]
            model.add_point3D(np.zeros(3), pycolmap.Track(elements), np.zeros(3, np.uint8))
            at += 1
    return model


def parts_of(model, smallest=3):
    return sorted(sorted(part.reg_image_ids()) for part in sound_models([model], smallest))


@pytest.mark.parametrize(("shared", "parts"), [(14, 2), (15, 1)])
def test_parts_that_share_few_points_become_separate_models(shared, parts):
    tracks = [(40, (1, 2)), (40, (2, 3)), (40, (4, 5)), (40, (5, 6)), (shared, (3, 4))]
    found = parts_of(model_of(tracks, 6))
    assert found == ([[1, 2, 3], [4, 5, 6]] if parts == 2 else [[1, 2, 3, 4, 5, 6]])


def test_a_photo_with_few_points_gets_no_pose():
    tracks = [(40, (1, 2, 3)), (29, (3, 4))]
    assert parts_of(model_of(tracks, 4)) == [[1, 2, 3]]


def test_a_photo_with_few_points_does_not_join_models():
    """Photos 1 and 2 are joined with photos 3 and 4 only by a photo that has too few points."""
    tracks = [(40, (1, 2)), (40, (3, 4)), (14, (2, 5)), (14, (5, 3))]
    assert parts_of(model_of(tracks, 5), smallest=2) == [[1, 2], [3, 4]]


def test_models_below_the_smallest_size_are_dropped():
    assert parts_of(model_of([(40, (1, 2))], 2)) == []
    assert parts_of(model_of([], 3)) == []


def test_a_sound_model_is_not_changed():
    model = model_of([(40, (1, 2, 3, 4))], 4)
    (same,) = sound_models([model], 3)
    assert same.num_points3D() == 40
    assert sorted(same.reg_image_ids()) == [1, 2, 3, 4]
