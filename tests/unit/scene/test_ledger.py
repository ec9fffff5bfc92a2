"""Photos, masks, depth, points and tables of a scene are used, or listed with a reason."""

import shutil

import numpy as np
import pytest
from support.formats import write_ply
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.registry.entries import build


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    return write_tiny_scene(
        tmp_path_factory.mktemp("master") / "scene", views=3, width=24, height=16, points=20
    )


@pytest.fixture
def scene(master, tmp_path):
    return shutil.copytree(master, tmp_path / "scene")


def read(path, reader="colmap", **options):
    return build("readers", reader, {}).read(path, SceneOptions(**options))


def unused(path, **options):
    return [note for note in read(path, **options).notes if note.startswith("unused")]


def copy(path, folder):
    return shutil.copytree(path / "images", path / folder)


def test_a_plain_scene_has_no_unused_files(scene):
    for name in ("README.txt", "poses_bounds.npy", "database.db", "report.png", ".hidden.png"):
        (scene / name).touch()
    assert unused(scene) == []


@pytest.mark.parametrize(
    ("folder", "reason"),
    [
        ("mask", "files whose names look like masks; use them with --set data.masks=FOLDER"),
        ("alpha_masks", "look like masks"),
        ("depth", "depth and normal maps are not used"),
        ("images_2", "smaller copies of the photos"),
        ("input", "outside the photo folder images/"),
    ],
)
def test_folders_of_images_are_listed_as_unused_with_the_reason(folder, reason, scene):
    copy(scene, folder)
    (note,) = unused(scene)
    assert note.startswith(f"unused: 3 files in {folder}/ (0000.png, 0001.png, 0002.png), ")
    assert reason in note


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("sparse/0/points3D.ply", "the scene has its own points; start from such a file with"),
        ("cloud.LAZ", "--points FILE"),
        ("gps.csv", "the reader does not read this table"),
        ("raw/0001.CR2", "raw files of a camera; save the photos as JPEG or PNG"),
        ("depth/0001.npy", "depth and normal maps"),
        ("maps/0001.exr", "depth and normal maps"),
    ],
)
def test_other_files_are_listed_as_unused_with_the_reason(name, reason, scene):
    (scene / name).parent.mkdir(exist_ok=True)
    (scene / name).touch()
    (note,) = unused(scene)
    assert name.rpartition("/")[2] in note and reason in note


def test_masks_without_a_photo_and_photos_without_a_mask_are_named(scene):
    copy(scene, "masks")
    (scene / "masks" / "0001.png").rename(scene / "masks" / "other.png")
    notes = read(scene).notes
    assert "masks: 1 of 3 have none, and all their pixels are used: 0001.png" in notes
    assert "unused: 1 file in masks/ (other.png), masks without a used photo" in notes


def test_used_files_are_not_listed_as_unused(scene):
    copy(scene, "seg")
    assert unused(scene, masks=scene / "seg") == []
    (scene / "images").rename(scene / "photos")
    (scene / "images").symlink_to(scene / "photos")
    assert unused(scene, masks=scene / "seg") == []
    write_ply(scene / "start.ply", np.zeros((2, 3)), np.zeros((2, 3), dtype=np.uint8))
    assert len(unused(scene, masks=scene / "seg")) == 1
    assert unused(scene, masks=scene / "seg", init=str(scene / "start.ply")) == []


def test_full_size_photos_are_not_listed_as_unused_if_smaller_copies_are_read(master, tmp_path):
    path = write_tiny_scene(tmp_path / "scene", views=3, width=96, height=64, points=20)
    shutil.copytree(master / "images", path / "images_4")
    scene = read(path, max_size=24)
    assert "from images_4/" in " ".join(scene.notes)
    assert not [note for note in scene.notes if note.startswith("unused")]


def test_run_folders_are_not_listed_as_unused(scene):
    copy(scene, "run/panels")
    assert len(unused(scene)) == 1
    (scene / "run" / "config.yaml").touch()
    assert unused(scene) == []


def test_many_unused_folders_give_few_lines(scene):
    for number in range(20):
        copy(scene, f"extra{number:02d}")
    notes = unused(scene)
    assert len(notes) == 9
    assert notes[-1] == "unused: 36 more files in extra08/, extra09/, extra10/ and 9 more"
