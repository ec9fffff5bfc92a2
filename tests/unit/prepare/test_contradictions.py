"""Photos whose matches contradict the pose that a model gives them."""

import numpy as np
import pycolmap
import pytest

from crossgrad_plugins.prepare import mapping
from crossgrad_plugins.prepare.contradictions import contradicted
from crossgrad_plugins.prepare.layout import Layout

PHOTOS = 8


@pytest.fixture
def made(tmp_path):
    """A model of a few photos of one camera with distortion, and the database of its matches."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, PHOTOS, 80
    pycolmap.set_random_seed(0)
    path = tmp_path / "database.db"
    database = pycolmap.Database.open(path)
    model = pycolmap.synthesize_dataset(options, database)
    database.close()
    return model, path


def misplace(model, number, along=2.0):
    """Moves a photo and turns it about its axis."""
    frame = model.frame(model.image(number).frame_id)
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.8]))
    frame.rig_from_world = (
        pycolmap.Rigid3d(turn, np.array([along, 0.0, 0.0])) * frame.rig_from_world
    )


def numbers(model):
    return sorted(model.reg_image_ids())


def test_correct_poses_are_not_contradicted(made):
    assert contradicted(*made) == {}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_misplaced_photos_are_contradicted(made, count):
    """The matches of a misplaced photo with all other photos contradict its pose."""
    model, path = made
    wrong = numbers(model)[:count]
    for at, number in enumerate(wrong):
        misplace(model, number, 2.0 + at)
    found = contradicted(model, path)
    assert sorted(found) == wrong
    assert all(votes[0] == 0 and votes[1] >= 30 * (PHOTOS - count) for votes in found.values())


def test_disagreement_with_a_single_photo_does_not_contradict_a_pose(made):
    """With only two photos, it is unknown which pose is wrong."""
    model, path = made
    one, *others = numbers(model)
    for number in others[1:]:
        model.deregister_frame(model.image(number).frame_id)
    misplace(model, one)
    assert contradicted(model, path) == {}


def test_a_pair_with_few_matches_does_not_contradict_a_pose(made):
    model, path = made
    wrong = numbers(model)[0]
    misplace(model, wrong)
    database = pycolmap.Database.open(path)
    for other in numbers(model)[1:]:
        geometry = database.read_two_view_geometry(wrong, other)
        geometry.inlier_matches = geometry.inlier_matches[:29]
        database.update_two_view_geometry(wrong, other, geometry)
    database.close()
    assert contradicted(model, path) == {}


def test_an_empty_model_has_no_contradicted_photos(tmp_path):
    database = pycolmap.Database.open(tmp_path / "database.db")
    database.close()
    assert contradicted(pycolmap.Reconstruction(), tmp_path / "database.db") == {}


def test_contradicted_photos_are_removed_from_the_model_and_recorded(made):
    model, path = made
    layout = Layout(path.parent / "scene")
    layout.work.mkdir(parents=True)
    path.replace(layout.database)
    wrong = numbers(model)[0]
    name = model.image(wrong).name
    misplace(model, wrong)
    (kept,) = mapping._without_misplaced(layout, [model])
    assert wrong not in kept.reg_image_ids()
    assert kept.num_reg_images() == PHOTOS - 1
    assert list(mapping.misplaced(layout)) == [name]
