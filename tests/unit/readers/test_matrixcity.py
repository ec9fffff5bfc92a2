"""Blocks of MatrixCity: which are found, which are held out, and their rotations."""

import shutil

import pytest
from support.formats import write_formats
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_plugins.readers.matrixcity import MatrixCityReader


@pytest.fixture
def blocks(tmp_path):
    """A scene of one block, to be copied about."""
    scene = write_tiny_scene(
        tmp_path / "scene", views=3, width=24, height=16, points=20, model="SIMPLE_PINHOLE",
        centered=True,
    )  # fmt: skip
    return write_formats(scene, tmp_path)["matrixcity"] / "block_1"


def read(path):
    return MatrixCityReader().read(path, SceneOptions(init="random"))


def test_a_block_is_read_as_a_scene(blocks):
    assert MatrixCityReader().accepts(blocks)
    assert [view.name for view in read(blocks).views] == [f"{k:04d}.png" for k in range(3)]


def test_photos_may_be_in_the_folder_of_their_poses(blocks):
    for photo in (blocks / "rgb").iterdir():
        photo.rename(blocks / photo.name)
    (blocks / "rgb").rmdir()
    assert len(read(blocks).views) == 3


@pytest.mark.parametrize("held_out", ["aerial/test/block_2", "aerial/block_1_test"])
def test_blocks_of_a_city_are_read_as_one_scene(held_out, blocks, tmp_path):
    city = tmp_path / "city"
    places = ("aerial/train/block_1", "street/train/small_city_road_down", held_out)
    for place in places:
        shutil.copytree(blocks, city / place)
    scene = read(city)
    assert MatrixCityReader().accepts(city)
    assert {view.name.rpartition("/rgb/")[0] for view in scene.test_views} == {held_out}
    assert {view.regime for view in scene.views} == {"aerial", "street"}
    assert len(scene.train) == 6


def test_blocks_are_not_searched_in_deep_or_linked_folders(blocks, tmp_path):
    shutil.copytree(blocks, tmp_path / "home" / "documents" / "block_1")
    (tmp_path / "home" / "block_9").symlink_to(blocks, target_is_directory=True)
    assert not MatrixCityReader().accepts(tmp_path / "home")
