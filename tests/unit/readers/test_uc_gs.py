"""Scenes in the manner of UC-GS: folders and names tell what is held out."""

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_plugins.readers._accepts import is_held_out
from crossgrad_plugins.readers.colmap import ColmapReader
from crossgrad_plugins.readers.uc_gs import UcGsReader


def read(path, **options):
    return UcGsReader().read(path, SceneOptions(**options))


def test_photos_of_test_folders_are_held_out(tmp_path):
    path = write_tiny_scene(
        tmp_path, views=3, width=24, height=16, points=60,
        folders=("traina20g1.5/street", "traina20g1.5/aerial", "test1.6/street"),
    )  # fmt: skip
    assert UcGsReader().accepts(path)
    scene = read(path)
    assert {view.name for view in scene.test_views} == {
        f"test1.6/street/{k:04d}.png" for k in range(3)
    }
    assert {view.regime for view in scene.views} == {"street", "aerial"}
    assert len(scene.train) == 6


def test_split_lists_of_the_user_have_priority(tmp_path):
    path = write_tiny_scene(
        tmp_path, views=2, width=24, height=16, points=60, folders=("train1", "test1")
    )
    (path / "test_list.txt").write_text("train1/0000.png\n")
    assert [view.name for view in read(path).test_views] == ["train1/0000.png"]


@pytest.mark.parametrize(
    ("name", "held_out"),
    [
        ("traina20g1.5/0001.png", False),
        ("test1.6d5/0001.png", True),
        ("Test/0001.png", True),
        ("train/x_eval_3.png", True),
        ("street/EVAL0003.jpg", True),
        ("medieval/0001.png", False),
        ("evaluation.png", False),
        ("contest/0001.png", False),
    ],
)
def test_held_out_photos_are_recognised_by_name(name, held_out):
    assert is_held_out(name) is held_out


def test_scenes_with_other_folders_are_read_by_colmap(tmp_path):
    path = write_tiny_scene(tmp_path, views=2, width=24, height=16, points=20)
    assert not UcGsReader().accepts(path)
    assert ColmapReader().accepts(path)
