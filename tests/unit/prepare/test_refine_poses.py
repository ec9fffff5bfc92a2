"""Photos that mapping left out or misplaced are placed by their pairs, and only those."""

from functools import partial

import numpy as np
import pycolmap
import pytest

from crossgrad_plugins.prepare import mapping
from crossgrad_plugins.prepare.pose_from_pairs import Pairs, PairView, Support, best_place, support
from crossgrad_plugins.prepare.refine_poses import looked_again, poses_of

PHOTOS, POINTS = 8, 120


@pytest.fixture
def made(tmp_path):
    """A model of a few photos of one camera with distortion, and the database of its matches."""
    return made_of(tmp_path, rigs=1)


def made_of(folder, rigs):
    """The same with so many cameras."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = rigs, PHOTOS // rigs
    options.num_points3D = POINTS
    pycolmap.set_random_seed(0)
    path = folder / "database.db"
    database = pycolmap.Database.open(path)
    model = pycolmap.synthesize_dataset(options, database)
    database.close()
    (folder / "scratch").mkdir()
    return model, path


class Adjust:
    """Takes the model as it is, and notes how it was asked."""

    def __init__(self):
        self.models = []

    def __call__(self, database, place):
        self.aside = laid_aside(database)
        self.models.append(pycolmap.Reconstruction(place))
        return self.models[-1]


def laid_aside(path):
    """How many pairs of all photos have no matches."""
    database = pycolmap.Database.open(path)
    _, counts = database.read_two_view_geometry_num_inliers()
    database.close()
    return PHOTOS * (PHOTOS - 1) // 2 - sum(count > 0 for count in counts)


def looked(made, *models):
    model, path = made
    adjust = Adjust()
    found, settled = looked_again([*(models or (model,))], path, path.parent / "scratch", adjust)
    return found, settled, adjust


def truth_of(model):
    return {number: pose.matrix() for number, pose in poses_of(model).items()}


def misplace(model, number):
    frame = model.frame(model.image(number).frame_id)
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.8]))
    frame.rig_from_world = pycolmap.Rigid3d(turn, np.array([2.0, 0, 0])) * frame.rig_from_world


def numbers(model):
    return sorted(model.reg_image_ids())


def change_matches(path, change):
    """Rewrites the matches of each pair as `change(one, two, matches)` has them."""
    database = pycolmap.Database.open(path)
    pairs, _ = database.read_two_view_geometry_num_inliers()
    for pair in pairs:
        one, two = pycolmap.pair_id_to_image_pair(pair)
        geometry = database.read_two_view_geometry(one, two)
        geometry.inlier_matches = change(one, two, np.asarray(geometry.inlier_matches))
        database.update_two_view_geometry(one, two, geometry)
    database.close()


def close_to(pose, truth):
    return np.allclose(pose.matrix(), truth, atol=0.02)


def test_a_model_that_agrees_with_its_pairs_is_not_changed(made):
    before = truth_of(made[0])
    (model,), settled, adjust = looked(made)
    assert adjust.models == [] and settled == frozenset()
    assert all(np.array_equal(pose.matrix(), before[n]) for n, pose in poses_of(model).items())
    assert list((made[1].parent / "scratch").iterdir()) == []


@pytest.mark.parametrize("count", [1, 3])
def test_misplaced_photos_move_to_the_pose_of_their_pairs(made, count):
    model, truth = made[0], truth_of(made[0])
    wrong = numbers(model)[:count]
    for number in wrong:
        misplace(model, number)
    (found,), settled, adjust = looked(made)
    assert len(adjust.models) >= 1 and settled == frozenset()
    assert numbers(found) == sorted(truth)
    for number, pose in poses_of(found).items():
        assert close_to(pose, truth[number])


def test_a_photo_without_a_pose_gets_a_pose_from_its_pairs(made, tmp_path):
    model, truth = made[0], truth_of(made[0])
    lost = numbers(model)[2]
    model.deregister_frame(model.image(lost).frame_id)
    # On a disk only photos with poses are kept.
    (tmp_path / "kept").mkdir()
    model.write(tmp_path / "kept")
    model = pycolmap.Reconstruction(tmp_path / "kept")
    assert not model.exists_image(lost)
    (found,), _, _ = looked(made, model)
    assert close_to(poses_of(found)[lost], truth[lost])
    assert found.image(lost).num_points2D() > 0


def test_two_directions_locate_a_photo_without_points(made):
    """The model contains only poses. The intersection of two directions gives the distance."""
    model, truth = made[0], truth_of(made[0])
    lost = numbers(model)[0]
    model.deregister_frame(model.image(lost).frame_id)
    for point in list(model.points3D):
        model.delete_point3D(point)
    (found,), _, _ = looked(made)
    assert close_to(poses_of(found)[lost], truth[lost])


def test_wrong_pairs_are_outvoted_and_removed(made):
    """The matches of three of the seven pairs of a photo are shuffled."""
    model, path = made
    truth, lost = truth_of(model), numbers(model)[0]
    wrong = set(numbers(model)[1:4])
    rng = np.random.default_rng(0)

    def mixed(one, two, matches):
        if lost in (one, two) and wrong & {one, two}:
            matches[:, 1] = rng.permutation(matches[:, 1])
        return matches

    change_matches(path, mixed)
    misplace(model, lost)
    (found,), settled, adjust = looked(made)
    assert close_to(poses_of(found)[lost], truth[lost])
    assert adjust.aside == 3 and laid_aside(path) == 0
    # Three of seven are many: it stays doubtful, but nothing better is known.
    assert settled == {lost}


@pytest.mark.slow
def test_mapping_continues_if_a_photo_has_no_pair_left(made, tmp_path):
    """One photo is misplaced. All pairs of another photo have shuffled matches and are removed."""
    model, path = made
    truth, (lost, strange, *_) = truth_of(model), numbers(model)
    rng = np.random.default_rng(0)

    def mixed(one, two, matches):
        if strange in (one, two):
            matches[:, 1] = rng.permutation(matches[:, 1])
        return matches

    change_matches(path, mixed)
    misplace(model, lost)
    photos = tmp_path / "photos"
    photos.mkdir()
    (found,), _ = looked_again(
        [model],
        path,
        tmp_path / "scratch",
        partial(mapping._adjusted, 1, photos, pycolmap.CancellationToken()),
    )
    assert strange not in numbers(found) and lost in numbers(found)
    others = [number for number in truth if number != strange]
    assert numbers(found) == sorted(others)


def test_level_photos_of_flat_ground_give_relative_rotations(made):
    """All matches of a pair are shifted equally, as by a watermark."""
    rays = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2)).astype(np.float32)
    shifted = rays + np.float32([0.1, 0.0])
    still = pycolmap.Rigid3d()
    sight = PairView(1, still, (600.0, 600.0), (rays, shifted), np.arange(200))
    relative = sight.relative()
    assert relative is not None
    assert np.allclose(relative.rotation.matrix(), np.eye(3), atol=0.05)


def test_a_single_pair_places_no_photo(made):
    model, path = made
    one, other, *_ = numbers(model)

    def only(first, second, matches):
        return matches if one not in (first, second) or other in (first, second) else matches[:0]

    change_matches(path, only)
    model.deregister_frame(model.image(one).frame_id)
    (found,), _, adjust = looked(made)
    assert one not in numbers(found) and adjust.models == []


def test_a_photo_moves_from_a_smaller_model_to_the_largest(made, tmp_path):
    model, truth = made[0], truth_of(made[0])
    (tmp_path / "small").mkdir()
    model.write(tmp_path / "small")
    small = pycolmap.Reconstruction(tmp_path / "small")
    first, second, third, *others = numbers(model)
    for number in others:
        small.deregister_frame(small.image(number).frame_id)
    for number in (first, second, third):
        model.deregister_frame(model.image(number).frame_id)
    # In the smaller model two pairs speak for each of them, in the larger one five.
    (large, left), _, _ = looked(made, small, model)
    assert numbers(large) == sorted(truth) and numbers(left) == []
    assert all(close_to(poses_of(large)[number], truth[number]) for number in truth)


@pytest.mark.slow
def test_a_refinement_round_with_fewer_supporting_matches_is_discarded(made):
    """Each mapping round moves all photos except two to wrong poses."""
    model, path = made
    truth, lost = truth_of(model), numbers(model)[0]
    misplace(model, lost)
    before = truth_of(model)

    def thrown_about(_, place):
        thrown = pycolmap.Reconstruction(place)
        for turn, number in enumerate(numbers(thrown)[2:]):
            for _ in range(turn + 1):
                misplace(thrown, number)
        return thrown

    (found,), _ = looked_again([model], path, path.parent / "scratch", thrown_about)
    assert truth_of(found)[lost] == pytest.approx(before[lost])
    assert all(
        close_to(pose, truth[number]) for number, pose in poses_of(found).items() if number != lost
    )


@pytest.mark.parametrize("in_other", [False, True])
@pytest.mark.parametrize("is_there", [False, True])
def test_a_camera_missing_in_the_largest_model_is_calibrated_from_other_models(
    tmp_path, is_there, in_other
):
    """Each photo has a separate camera. The database contains only estimated focal lengths."""
    model, path = made_of(tmp_path, rigs=PHOTOS)
    known = {number: camera.params.copy() for number, camera in model.cameras.items()}
    database = pycolmap.Database.open(path)
    for number in known:
        camera = database.read_camera(number)
        camera.params = camera.params * np.array([1.6, *[1.0] * (len(camera.params) - 1)])
        database.update_camera(camera)
    database.close()
    truth, lost = truth_of(model), numbers(model)[0]
    camera = model.image(lost).camera_id
    (tmp_path / "small").mkdir()
    model.write(tmp_path / "small")
    small = pycolmap.Reconstruction(tmp_path / "small")
    others = numbers(model)[:3] if in_other else numbers(model)[-3:]
    for number in set(numbers(model)) - set(others):
        small.deregister_frame(small.image(number).frame_id)
    model.deregister_frame(model.image(lost).frame_id)
    model.camera(camera).params = known[camera] * np.array([1.6, *[1.0] * (len(known[camera]) - 1)])
    if not is_there:
        model.tear_down()
    assert model.exists_camera(camera) == is_there
    (found, _), _ = looked_again([model, small], path, tmp_path / "scratch", Adjust())
    assert close_to(poses_of(found)[lost], truth[lost])
    assert found.camera(camera).params == pytest.approx(known[camera])


def test_a_failed_mapping_keeps_the_previous_model(made, caplog):
    model, path = made
    misplace(model, numbers(model)[0])
    before = truth_of(model)

    def failing(*_):
        raise RuntimeError("no room for points")

    (found,), _ = looked_again([model], path, path.parent / "scratch", failing)
    assert all(np.array_equal(pose.matrix(), before[n]) for n, pose in poses_of(found).items())
    assert "doubtful photos keep their poses" in caplog.text


def test_a_photo_with_an_impossible_camera_is_left_out(tmp_path):
    model, path = made_of(tmp_path, rigs=PHOTOS)
    one, two, strange, *others = numbers(model)
    misplace(model, one)
    misplace(model, two)

    def exploded(_, place):
        found = pycolmap.Reconstruction(place)
        camera = found.camera(found.image(strange).camera_id)
        camera.params = [1e6 * each for each in camera.params]
        return found

    (found,), _ = looked_again([model], path, tmp_path / "scratch", exploded)
    assert numbers(found) == [one, two, *others]


def test_no_photo_is_moved_after_a_stop_request(made):
    model, path = made
    misplace(model, numbers(model)[0])
    adjust = Adjust()
    (found,), _ = looked_again([model], path, path.parent / "scratch", adjust, lambda: True)
    assert adjust.models == [] and found is model


def test_refining_an_empty_list_of_models_returns_an_empty_list(tmp_path):
    assert looked_again([], tmp_path / "database.db", tmp_path, Adjust()) == ([], frozenset())


def test_the_correct_pose_has_more_support_than_other_poses(made):
    model, path = made
    number = numbers(model)[0]
    database = pycolmap.Database.open(path)
    pairs = Pairs(model.cameras, database)
    sights = pairs.sights(number, poses_of(model))
    database.close()
    assert len(sights) == PHOTOS - 1
    matches = sum(len(sight.features) for sight in sights)
    right = poses_of(model)[number]
    assert support(sights, right) == Support(matches, PHOTOS - 1)
    most, pose = best_place(model, sights)
    assert most == Support(matches, PHOTOS - 1) and close_to(pose, right.matrix())
    away = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([5.0, 0, 0])) * right
    assert support(sights, away) == Support()
    assert best_place(model, []) == (Support(), None)


@pytest.mark.parametrize(
    ("pairs", "matches", "enough"),
    [(1, 900, False), (2, 99, False), (2, 100, True), (3, 59, False), (3, 60, True)],
)
def test_the_support_for_a_pose_must_have_enough_pairs_and_matches(pairs, matches, enough):
    assert Support(matches, pairs).enough == enough
