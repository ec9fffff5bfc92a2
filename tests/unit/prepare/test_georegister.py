"""Models on Earth: similarities from GPS with outliers, and models that GPS joins."""

import tracemalloc

import numpy as np
import pycolmap
import pytest

from crossgrad_plugins.prepare import georegister
from crossgrad_plugins.prepare.earth import top_of
from crossgrad_plugins.prepare.georegister import centers_of, merged, placement_of


def synthetic(frames=12, seed=0):
    """A model of pycolmap's own making; no photo belongs to it."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, frames // 2, 60
    return pycolmap.synthesize_dataset(options)


def tops_of(model):
    return {name: top_of(1) for name in centers_of(model)}


def similarity(rng):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    matrix = np.column_stack([rng.uniform(5.0, 50.0) * turn, rng.normal(size=3) * 100.0])
    return pycolmap.Sim3d(matrix)


def moved(similarity, points):
    return {
        name: similarity.matrix()[:, :3] @ point + similarity.matrix()[:, 3]
        for name, point in points.items()
    }


@pytest.mark.parametrize("seed", range(5))
def test_the_similarity_is_found_despite_wrong_gps(seed):
    rng, model = np.random.default_rng(seed), synthetic()
    centers, wanted = centers_of(model), similarity(np.random.default_rng(seed))
    gps = moved(wanted, centers)
    wrong = sorted(gps)[: len(gps) // 4]
    for name in sorted(gps):
        gps[name] = gps[name] + rng.normal(size=3) * (400.0 if name in wrong else 0.05)
    placement, why = placement_of(model, gps, tops_of(model))
    assert not why
    assert placement.agreeing.isdisjoint(wrong)
    assert placement.rms < 0.5
    found = placement.similarity
    assert found.scale == pytest.approx(wanted.scale, rel=0.01)
    exact = moved(wanted, centers)
    for name, place in moved(found, centers).items():
        assert np.linalg.norm(place - exact[name]) < 0.5


def test_gps_positions_on_a_line_do_not_georegister_a_model():
    model = synthetic()
    names = sorted(centers_of(model))
    gps = {name: np.array([10.0 * i, 0.0, 0.0]) for i, name in enumerate(names)}
    assert placement_of(model, gps, tops_of(model))[0] is None


def walk(rng, orientation, pitch, count=12):
    """A model of photos taken on a straight way, and the frame in which z is up.

    Held level, turned as the orientation says, looking anywhere, tilted up by the pitch in degrees.
    """
    shown = {1: np.eye(3), 6: np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])}[orientation]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 80, 60)
    )
    for number in range(1, count + 1):
        yaw, tilt = rng.uniform(0.0, 2.0 * np.pi), np.deg2rad(pitch)
        ahead = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        upright = np.stack([right, np.cross(ahead, right), ahead])
        pose = pycolmap.Rotation3d(shown.T @ upright)
        center = np.array([8.0 * number, 3.0 * number, 0.1 * number])
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose, -pose.matrix() @ center))
    return model


@pytest.mark.sampled(7)
@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("pitch", [-50.0, 0.0, 15.0])
@pytest.mark.parametrize("seed", range(3))
def test_on_a_straight_track_level_photos_give_the_up_direction(orientation, pitch, seed):
    rng = np.random.default_rng(seed)
    model = walk(rng, orientation, pitch)
    gps = {name: at + 0.1 * rng.normal(size=3) for name, at in centers_of(model).items()}
    wanted = similarity(rng)
    model.transform(wanted)
    tops = {name: top_of(orientation) for name in gps}
    placement, why = placement_of(model, gps, tops)
    assert not why
    up = placement.similarity.rotation.matrix() @ wanted.rotation.matrix() @ [0.0, 0.0, 1.0]
    assert up[2] > np.cos(np.deg2rad(3.0))
    assert placement.rms < 0.5


def test_a_long_straight_track_needs_no_memory_for_all_pairs_of_photos():
    rng = np.random.default_rng(0)
    here = np.arange(3_000.0)[:, None] * [1.0, 0.2, 0.0]
    there = 4.0 * here + rng.normal(0.0, 0.5, here.shape)
    tracemalloc.start()
    similarity, agrees = georegister._on_a_line(here, there)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert similarity.scale == pytest.approx(4.0, rel=1e-3) and agrees.all()
    assert most < 100 * 2**20


def test_sideways_photos_on_a_straight_track_do_not_georegister_a_model():
    rng = np.random.default_rng(0)
    model = walk(rng, 1, 0.0)
    gps = {name: at + 0.1 * rng.normal(size=3) for name, at in centers_of(model).items()}
    # The axis that is level in each photo is that of the way.
    along = np.array([8.0, 3.0, 0.1]) / np.linalg.norm([8.0, 3.0, 0.1])
    ahead = np.cross(along, [0.0, 0.0, 1.0])
    ahead /= np.linalg.norm(ahead)
    pose = pycolmap.Rotation3d(np.stack([-along, np.cross(ahead, -along), ahead]))
    for number in model.reg_image_ids():
        center = model.image(number).projection_center()
        model.frame(number).rig_from_world = pycolmap.Rigid3d(pose, -pose.matrix() @ center)
    placement, why = placement_of(model, gps, tops_of(model))
    assert placement is None
    assert "the upward direction" in why


def test_gps_coarser_than_the_scene_does_not_georegister_a_model():
    rng, model = np.random.default_rng(0), synthetic()
    gps = {name: rng.normal(size=3) * 0.5 for name in centers_of(model)}
    placement, why = placement_of(model, gps, tops_of(model))
    assert placement is None
    assert "GPS" in why


def test_fewer_than_three_photos_with_gps_do_not_georegister_a_model():
    model = synthetic()
    gps = dict(list(moved(similarity(np.random.default_rng(0)), centers_of(model)).items())[:2])
    assert (
        placement_of(model, gps, tops_of(model))[1]
        == "2 of its photos have GPS, but at least 3 are needed"
    )


def part_of(model, keep, folder):
    """A model of some of the photos of another, as mapping leaves it: read from its files."""
    part = pycolmap.Reconstruction(model)
    for number in list(part.reg_image_ids()):
        if number not in keep:
            part.deregister_frame(part.image(number).frame_id)
    folder.mkdir()
    part.write(folder)
    return pycolmap.Reconstruction(folder)


def test_two_halves_are_merged_into_the_whole_model(tmp_path):
    """The merged model contains photos, poses and points of both halves, and each photo once."""
    model = synthetic()
    numbers = sorted(model.reg_image_ids())
    parts = {"one": set(numbers[:7]), "other": set(numbers[5:])}
    halves = [part_of(model, keep, tmp_path / name) for name, keep in parts.items()]
    whole = merged(halves[0], halves[1:])
    whole.write(tmp_path)
    read = pycolmap.Reconstruction(tmp_path)
    assert sorted(read.reg_image_ids()) == numbers
    before, after = centers_of(model), centers_of(read)
    assert before.keys() == after.keys()
    for name, center in before.items():
        assert np.allclose(after[name], center)
    assert read.is_valid()
    assert read.compute_mean_reprojection_error() < 1e-3
    assert read.num_points3D() >= halves[0].num_points3D()
