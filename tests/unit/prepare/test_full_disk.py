"""A disk that fills up: pycolmap does not say so, and nothing cut short gets its name."""

import os
import shutil
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from crossgrad_core.errors import UserError
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.system import check_writable
from crossgrad_plugins.prepare import features, mapping, matching, undistortion
from crossgrad_plugins.prepare.layout import Layout, check_ours, clear_damaged, clear_leftovers
from crossgrad_plugins.prepare.plan import Photo, Plan, Settings
from crossgrad_plugins.prepare.pycolmap_calls import is_whole, write_model
from crossgrad_plugins.prepare.refine_poses import _Again
from crossgrad_plugins.prepare.results import _place

FULL = "not enough disk space"
FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
WRITE = pycolmap.Reconstruction.write


@pytest.fixture(scope="module")
def model():
    """A model as this version of pycolmap writes it, of the bundled photos."""
    return pycolmap.Reconstruction(bundled_scene() / "sparse" / "0")


@pytest.fixture
def layout(tmp_path):
    found = Layout(tmp_path / "scene")
    found.work.mkdir(parents=True)
    return found


@pytest.fixture
def full(monkeypatch):
    """A disk on which models are cut short, without a word."""

    def write(model, folder):
        WRITE(model, folder)
        cut(folder)

    monkeypatch.setattr(pycolmap.Reconstruction, "write", write)


@pytest.fixture
def free(monkeypatch):
    """Sets how many bytes are free."""

    def set_free(count):
        monkeypatch.setattr(check_writable, "free_bytes", lambda _: count)

    return set_free


def cut(folder, name="points3D.bin", size=0):
    os.truncate(folder / name, size)


def written(model, folder):
    folder.mkdir(parents=True)
    WRITE(model, folder)
    return folder


def plan_of(model, root, **changed):
    one = next(iter(model.cameras.values()))
    photos = [
        Photo(
            name=model.image(number).name, folder="", width=one.width, height=one.height,
            orientation=1, camera="a", position=None, brightness=100.0, sharpness=300.0, bytes=1,
            sha256="0" * 64, **changed,
        )
        for number in model.reg_image_ids()
    ]  # fmt: skip
    return Plan(photos=str(root), settings=Settings(), used=tuple(photos), left_out=())


@pytest.mark.parametrize("name", FILES)
def test_truncated_or_incomplete_models_are_reported(model, name, tmp_path):
    folder = written(model, tmp_path / "0")
    assert is_whole(folder)
    size = (folder / name).stat().st_size
    for left in (size - 1, size // 2, 0):
        cut(folder, name, left)
        assert not is_whole(folder)
    (folder / name).unlink()
    assert not is_whole(folder)


def test_a_truncated_model_gives_one_error(model, full, tmp_path):
    with pytest.raises(UserError, match=FULL):
        write_model(model, tmp_path)
    # What pycolmap says of a file that cannot even be made.
    with pytest.raises(UserError, match=FULL):
        write_model(model, tmp_path / "gone")


def test_mapping_returns_no_truncated_model(model, layout, full, monkeypatch):
    ways = {"_incremental": lambda *_: {0: model}, "way_of": lambda _: "incremental"}
    ways |= {"_looked_again": lambda *_: ([model], frozenset())}
    ways |= {"_without_misplaced": lambda _, models, __: models}
    for name, way in ways.items():
        monkeypatch.setattr(mapping, name, way)
    plan = plan_of(model, layout.scene)
    with pytest.raises(UserError, match=FULL):
        mapping.found_models(layout, plan, 1)
    assert not layout.models.exists()
    monkeypatch.setattr(pycolmap.Reconstruction, "write", WRITE)
    (found,) = mapping.found_models(layout, plan, 1)
    assert found.num_points3D() == model.num_points3D()


def test_a_partly_written_georegistered_model_is_not_kept(model, layout, full):
    with pytest.raises(UserError, match=FULL):
        _place(layout, plan_of(model, layout.scene), [pycolmap.Reconstruction(model)])
    assert not layout.placed.exists()


def test_bundle_adjustment_does_not_read_a_truncated_model(model, full, tmp_path, monkeypatch):
    """Pycolmap would read the truncated model without end."""
    place = written(model, tmp_path / "0")
    monkeypatch.setattr(pycolmap, "triangulate_points", lambda *_, **__: model)
    with pytest.raises(UserError, match=FULL):
        mapping._adjusted(1, tmp_path, pycolmap.CancellationToken(), tmp_path / "a.db", place)


def test_truncated_models_of_earlier_versions_are_created_again(model, layout):
    def made():
        for folder in (layout.models / "0", layout.placed, layout.model):
            shutil.rmtree(folder, ignore_errors=True)
            written(model, folder)

    made()
    clear_damaged(layout)
    assert layout.models.is_dir() and layout.placed.is_dir() and layout.model.is_dir()
    cut(layout.placed)
    clear_damaged(layout)
    assert layout.models.is_dir() and not layout.placed.exists() and not layout.model.exists()
    made()
    cut(layout.models / "0")
    clear_damaged(layout)
    assert not layout.models.exists() and not layout.placed.exists() and not layout.model.exists()


def test_a_truncated_finished_scene_is_refused_with_a_remedy(model, layout, tmp_path):
    for folder in (layout.models / "0", layout.placed, layout.model):
        written(model, folder)
    layout.images.mkdir()
    for file in (layout.plan, layout.features, layout.links, layout.report):
        file.touch()
    check_ours(layout, tmp_path)
    cut(layout.model)
    with pytest.raises(UserError, match="incomplete") as caught:
        check_ours(layout, tmp_path)
    assert f"remove {layout.report}" in str(caught.value)


def scene_of_png(model, layout):
    """The placed model, and its photos as PNG files in the folder of the plan."""
    root = layout.scene.with_name("photos")
    root.mkdir()
    renamed = pycolmap.Reconstruction(model)
    for number in renamed.reg_image_ids():
        renamed.image(number).name = f"{number}.png"
    written(renamed, layout.placed)
    plan = plan_of(renamed, root)
    for photo in plan.used:
        Image.new("RGB", (photo.width, photo.height), "green").save(root / photo.name)
    return plan


def test_photos_and_model_get_their_final_names_when_they_are_complete(model, layout, monkeypatch):
    plan, undistort = scene_of_png(model, layout), pycolmap.undistort_images
    what = ["images/1.png", 100]

    def cut_short(work, *given, **options):
        undistort(work, *given, **options)
        cut(work, *what)

    first = min(photo.name for photo in plan.used)
    what[0] = f"images/{first}"
    monkeypatch.setattr(pycolmap, "undistort_images", cut_short)
    with pytest.raises(UserError, match="could not be written"):
        undistortion.write_scene(layout, plan, 1)
    assert not (layout.images / first).exists()
    what[:] = ["sparse/points3D.bin", 0]
    with pytest.raises(UserError, match=FULL):
        undistortion.write_scene(layout, plan, 1)
    assert not layout.model.exists()
    monkeypatch.setattr(pycolmap, "undistort_images", undistort)
    undistortion.write_scene(layout, plan, 1)
    assert is_whole(layout.model) and len(list(layout.images.iterdir())) == len(plan.used)


def test_a_mask_that_cannot_be_written_is_not_left_in_the_folder(model, layout, monkeypatch):
    root = layout.scene.parent
    one = next(iter(model.cameras.values()))
    Image.fromarray(np.full((one.height, one.width), 255, np.uint8)).save(root / "mask.png")
    plan = plan_of(model, root, mask=str(root / "mask.png"))

    def no_room(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", no_room)
        with pytest.raises(UserError, match=FULL):
            undistortion._write_masks(layout, plan, model)
    assert not list(layout.masks.iterdir())
    undistortion._write_masks(layout, plan, model)
    assert len(list(layout.masks.iterdir())) == len(plan.used)


def test_partly_written_masks_of_killed_processes_are_deleted(layout):
    layout.masks.mkdir()
    names = (".a.jpg.png.12.tmp", "a.jpg.png", ".mine.png")
    for name in names:
        (layout.masks / name).touch()
    clear_leftovers(layout)
    assert {path.name for path in layout.masks.iterdir()} == {"a.jpg.png", ".mine.png"}


def test_writing_photos_requires_enough_disk_space(model, layout, free, monkeypatch):
    """The JPEG writer ends the process if it cannot write."""
    plan = scene_of_png(model, layout)
    monkeypatch.setattr(undistortion, "_undistort", lambda *_: pytest.fail("it was begun"))
    free(len(plan.used) * plan.used[0].width * plan.used[0].height // 2)
    with pytest.raises(UserError, match=FULL):
        undistortion.write_scene(layout, plan, 1)


def test_features_and_matches_require_enough_disk_space(model, layout, free, monkeypatch):
    """SQLite ends the process if it cannot write."""
    for module in (features, matching):
        monkeypatch.setattr(module, "waited", lambda *_: pytest.fail("it was begun"))
    plan = plan_of(model, layout.scene)
    free(2**20)
    with pytest.raises(UserError, match=FULL):
        features.found_features(layout, plan, 1)
    with pytest.raises(UserError, match=FULL):
        matching.found_links(layout, plan, 1)


def test_finished_features_need_no_disk_space(model, layout, monkeypatch):
    plan, photos = plan_of(model, layout.scene), len(model.images)
    layout.database.touch()
    asked = {}
    for done in (0, photos // 2, photos):
        monkeypatch.setattr(features, "rows_of", lambda *_, done=done: done)
        asked[done] = features._room(layout, plan)
    assert asked[0] > asked[photos // 2] > asked[photos] == features.JOURNAL
    pairs = photos * (photos - 1) // 2
    monkeypatch.setattr(matching, "rows_of", lambda *_: pairs + photos)
    assert matching._room(layout, plan, "exhaustive") == matching.JOURNAL


def test_copying_the_database_requires_enough_disk_space(tmp_path, free):
    database = tmp_path / "a.db"
    pycolmap.Database.open(database).close()
    again = _Again(database, tmp_path / "b.db", pycolmap.Reconstruction(), [], lambda: False)
    free(2**20)
    with pytest.raises(UserError, match=FULL):
        again.move(pycolmap.Reconstruction(), SimpleNamespace(better={}))
    assert not again.copy.exists()
