"""Scenes in memory that are right, or that contradict themselves in one of many ways."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.scenes import write_tiny_scene
from support.scripts import BENCHMARKS

from crossgrad_core.commands import configured
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import read_and_check, read_scene
from crossgrad_core.scene.self_check.check import checked
from crossgrad_core.scene.self_check.evidence import pixels_of
from crossgrad_core.scene.self_check.verdict import verdict_of

KINDS = (
    "OpenGL axes",
    "camera-to-world poses",
    "exchanged photos",
    "mirrored photos",
    "rotated photos",
    "wrong focal length",
    "turned cameras",
    "wrong principal point",
    "scaled points",
    "photos shifted by one",
    "half of the photos elsewhere",
    "points with y and z exchanged",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A right scene on disk."""
    folder = tmp_path_factory.mktemp("scenes") / "right"
    return write_tiny_scene(folder, views=16, width=96, height=64, points=600, centered=True)


@pytest.fixture(scope="module")
def contradictions():
    """The module with the kinds of contradictions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        import _contradictions

        yield _contradictions


@pytest.fixture(scope="module")
def model(folder, contradictions):
    """The right scene in memory, moved away from the origin that its points surround."""
    config = configured({"scene": str(folder), "threads": 1})
    right = contradictions.Model.of(read_scene(config, folder)[0])
    offset = np.array([0.3, -0.8, 0.5])
    moved = replace(right, points=right.points + offset)
    return moved.posed(right.rotations, right.centers + offset)


def without_tracks(model):
    return replace(model, seen=[np.zeros(0, dtype=np.int64) for _ in model.seen])


def found(model):
    scene = model.scene()
    return verdict_of(scene, range(len(scene.views)), pixels_of(scene))


def causes(verdict):
    return [each.what for each in (verdict.all_wrong, *verdict.some_wrong) if each is not None]


@pytest.mark.parametrize("tracks", [True, False])
def test_the_self_check_of_a_correct_scene_reports_no_contradiction(model, tracks):
    verdict = found(model if tracks else without_tracks(model))
    assert not causes(verdict)
    assert verdict.correlation > 0.8
    assert verdict.compared == 16


def test_the_self_check_is_tested_with_all_kinds_of_contradictions(contradictions):
    assert tuple(contradictions.KINDS) == KINDS


@pytest.mark.sampled(7)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, 2, 4])
def test_each_kind_of_contradiction_is_reported_with_cause_or_photos(
    contradictions, model, kind, seed
):
    wrong = contradictions.KINDS[kind](model, np.random.default_rng(seed))
    verdict = found(wrong.model)
    if wrong.views:
        assert verdict.all_wrong is None
        named = {view for cause in verdict.some_wrong for view in cause.views}
        assert named <= wrong.views
        assert 2 * len(named) >= len(wrong.views)
    else:
        assert any(word in cause for word in wrong.causes for cause in causes(verdict))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["OpenGL axes", "camera-to-world poses", "scaled points"])
def test_the_cause_of_a_contradiction_is_found_without_tracks(contradictions, model, kind):
    wrong = contradictions.KINDS[kind](without_tracks(model), np.random.default_rng(0))
    assert any(word in cause for word in wrong.causes for cause in causes(found(wrong.model)))


@pytest.mark.parametrize("axis", [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
def test_a_rotated_camera_without_tracks_is_named(model, axis):
    rotations = model.rotations.copy()
    rotations[5] = (
        Rotation.from_rotvec(np.radians(170.0) * np.array(axis)).as_matrix() @ rotations[5]
    )
    turned = without_tracks(model).posed(rotations, model.centers)
    (cause,) = found(turned).some_wrong
    assert cause.views == (5,)


def test_the_cause_of_a_contradiction_is_found_if_point_colours_are_noisy(contradictions, model):
    noise = np.random.default_rng(0).normal(0.0, 130.0, model.colors.shape)
    colors = np.clip(model.colors + noise, 0, 255).astype(np.uint8)
    right = replace(without_tracks(model), colors=colors)
    assert 0.35 < found(right).correlation < 0.45
    wrong = contradictions.KINDS["OpenGL axes"](right, np.random.default_rng(0))
    assert any("OpenGL" in cause for cause in causes(found(wrong.model)))


@pytest.mark.parametrize("seed", range(12))
def test_illumination_noise_jpeg_and_another_frame_are_no_contradiction(
    contradictions, model, seed
):
    rng = np.random.default_rng(seed)
    assert not causes(found(contradictions.harmless(contradictions.varied(model, rng), rng)))


def test_points_of_one_colour_are_compared_between_the_photos_of_their_tracks(model):
    grey = replace(model, colors=np.full_like(model.colors, 128))
    verdict = found(grey)
    assert verdict.compared == 16
    assert not causes(verdict)
    assert "photos are compared with each other" in verdict.notes[0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("tracks", [True, False])
def test_points_of_random_colours_give_no_warning(model, tracks):
    colors = np.random.default_rng(1).integers(0, 256, model.colors.shape).astype(np.uint8)
    random = replace(model, colors=colors)
    assert not causes(found(random if tracks else without_tracks(random)))


def test_a_scene_without_points_gives_no_warning(model):
    none = replace(model, points=np.zeros((0, 3)), colors=np.zeros((0, 3), dtype=np.uint8))
    verdict = found(without_tracks(none))
    assert verdict.compared == 0
    assert not causes(verdict)


def test_masked_pixels_are_no_contradiction(model):
    class Half:
        def __init__(self, pixels):
            self.pixels = pixels

        def image(self):
            return self.pixels.image()

        def mask(self):
            image = self.pixels.image()
            keep = image[..., 0].bool() | True
            keep[:, : image.shape[1] // 2] = False
            return keep

    scene = model.scene()
    views = tuple(replace(view, photo=Half(view.photo)) for view in scene.views)
    masked = replace(scene, views=views)
    verdict = verdict_of(masked, range(len(views)), pixels_of(masked))
    assert not causes(verdict)
    assert verdict.in_frame > 0.95


def exchange(folder, first, second):
    a, b = folder / "images" / first, folder / "images" / second
    other = b.read_bytes()
    b.write_bytes(a.read_bytes())
    a.write_bytes(other)


def test_photos_that_disagree_are_named_in_a_note_and_in_the_results(tmp_path, caplog):
    folder = write_tiny_scene(tmp_path / "s", views=12, width=96, height=64, points=600)
    exchange(folder, "0003.png", "0007.png")
    config = configured({"scene": str(folder), "threads": 1})
    scene, _ = read_and_check(config, folder)
    (note,) = (note for note in scene.notes if note.startswith("check:"))
    assert "0003.png, 0007.png" in note
    assert note in caplog.text
    assert scene.check["verdict"] == "some photos do not match"
    assert scene.check["disagreeing"] == ["0003.png", "0007.png"]


@pytest.mark.parametrize("damaged", [1, 6])
def test_photos_that_cannot_be_decoded_are_named_and_left_out(tmp_path, damaged):
    folder = write_tiny_scene(tmp_path / "s", views=6)
    names = sorted(path.name for path in (folder / "images").iterdir())[:damaged]
    for name in names:
        content = bytearray((folder / "images" / name).read_bytes())
        start, end = content.index(b"IDAT") + 4, content.rindex(b"IEND") - 8
        content[start:end] = bytes(end - start)
        (folder / "images" / name).write_bytes(content)
    scene, _ = read_and_check(configured({"scene": str(folder), "threads": 1}), folder)
    assert scene.check["compared"] <= 6 - damaged
    (warning,) = scene.check["warnings"]
    assert names[0] in warning and "decoded" in warning


def test_a_contradictory_scene_is_refused_unless_the_user_accepts_it(contradictions, model):
    wrong = contradictions.KINDS["OpenGL axes"](model, np.random.default_rng(0)).model.scene()
    with pytest.raises(UserError, match="do not match its poses and points") as error:
        checked(wrong, Path("scene"), cache_mib=1280)
    assert "OpenGL axes" in error.value.found
    assert "--accept-scene" in error.value.todo
    accepted = checked(wrong, Path("scene"), cache_mib=1280, accept=True)
    assert any("OpenGL axes" in note for note in accepted.notes)
    assert accepted.check["verdict"] == "points, poses and photos do not match"


def test_evenly_spread_photos_of_a_very_large_scene_are_checked(model):
    scene = model.scene()
    large = [
        replace(view, camera=replace(view.camera, width=4000, height=3000)) for view in scene.views
    ]
    few = checked(replace(scene, views=tuple(large)), Path("scene"), cache_mib=400, accept=True)
    assert 0 < few.check["compared"] < len(scene.views)


def test_the_self_check_notes_equal_poses_equal_photos_and_points_at_infinity(model):
    rotations, centers = model.rotations.copy(), model.centers
    rotations[2], centers[2] = rotations[1], centers[1]
    photos = list(model.photos)
    photos[2] = photos[1]
    seen = list(model.seen)
    seen[2] = seen[1]
    points = np.vstack([model.points, [[1e7, 0, 0]]])
    colors = np.vstack([model.colors, [[9, 9, 9]]]).astype(np.uint8)
    odd = replace(model, photos=photos, seen=seen, points=points, colors=colors)
    scene = checked(odd.posed(rotations, centers).scene(), Path("scene"), cache_mib=1280)
    notes = " | ".join(note for note in scene.notes if note.startswith("check:"))
    assert "1 photo with the same pose as another photo: 0002.png" in notes
    assert "almost equal: 0001.png and 0002.png" in notes
    assert "1 point extremely far away" in notes


def test_the_self_check_notes_dark_and_blurred_photos(model):
    photos = list(model.photos)
    photos[3] = (photos[3] // 60).astype(np.uint8)
    height, width = photos[5].shape[:2]
    across = np.linspace(0, 255, width)[None, :, None]
    photos[5] = np.broadcast_to(across, (height, width, 3)).astype(np.uint8)
    scene = checked(replace(model, photos=photos).scene(), Path("scene"), cache_mib=1280)
    notes = " | ".join(note for note in scene.notes if note.startswith("check:"))
    assert "1 photo (0003.png) much darker or brighter" in notes
