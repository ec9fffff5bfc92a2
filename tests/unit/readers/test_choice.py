"""Which reader takes a folder, and what the user is told where several do, or none."""

import shutil

import pytest
from support.formats import write_formats
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.assemble import read_scene


@pytest.fixture
def forms(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=2, width=24, height=16, points=20)
    return write_formats(scene, tmp_path)


def test_a_folder_that_two_readers_accept_is_refused_with_the_option(forms):
    path = forms["nerfstudio"]
    shutil.copytree(forms["colmap"] / "sparse", path / "colmap" / "sparse")
    with pytest.raises(UserError, match="files of several formats") as caught:
        read_scene(RunConfig(scene=path), path)
    assert caught.value.found == "files for the readers colmap, nerfstudio"
    assert "--reader colmap" in caught.value.todo
    for name in ("colmap", "nerfstudio"):
        assert read_scene(RunConfig(scene=path, reader={"name": name}), path)[1] == name


def test_reader_options_apply_to_the_selected_reader(forms):
    path = forms["nerfstudio"]
    (path / "transforms.json").rename(path / "other.json")
    (path / "transforms.json").write_text("{}")
    config = RunConfig(scene=path, reader={"name": "auto", "file": "other.json"})
    assert read_scene(config, path)[1] == "nerfstudio"


def test_a_folder_without_a_reader_is_refused_with_the_missing_file(tmp_path):
    with pytest.raises(UserError, match="no COLMAP model") as caught:
        read_scene(RunConfig(scene=tmp_path), tmp_path)
    assert "docs/readers.md" in caught.value.todo


@pytest.mark.parametrize("name", ["cameras.csv", "notes.xml", "transforms.json"])
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\0", b"<html/>", b"a,b\n1,2\n", b"[]"])
def test_unrelated_files_are_accepted_by_no_reader(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert not [each for each in entries("readers") if build("readers", each, {}).accepts(tmp_path)]
