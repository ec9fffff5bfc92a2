"""Files from outside: regular ones of bounded size, whatever else stands in their place."""

import os
import socket

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.run.camera_path import _read as read_path
from crossgrad_core.run.results.lock import locked
from crossgrad_core.run.results.log import RunLog
from crossgrad_core.run.results.scene_file import read_scene_file
from crossgrad_core.scene.split import _read_list as read_list
from crossgrad_core.system.input_files import is_file, open_file, read_file
from crossgrad_core.system.ply_table import read_vertices
from crossgrad_core.system.text_files import read_json, read_rows
from crossgrad_core.system.yaml_values import read_mapping
from crossgrad_core.training.per_image_params import read_values

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")

#: Parsers of one file each; what they raise where it cannot be read.
PARSERS = {
    "json": (read_json, ValueError),
    "csv": (lambda path: read_rows(path, "the table", "mend it"), UserError),
    "yaml": (lambda path: read_mapping(path, "the grid", "mend it"), UserError),
    "camera path": (lambda path: read_path(path, None), UserError),
    "exposure": (lambda path: read_values(path, {}), UserError),
    "ply": (read_vertices, UserError),
}


@pytest.fixture(params=["pipe", "device", "socket", "folder", "link to a pipe", "a very long name"])
def odd(request, tmp_path):
    """Something in instead of a file."""
    path = tmp_path / "odd"
    match request.param:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "socket":
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(str(path))
        case "folder":
            path.mkdir()
        case "link to a pipe":
            os.mkfifo(tmp_path / "pipe")
            path.symlink_to(tmp_path / "pipe")
        case _:
            path = tmp_path / ("a" * 300)
    return path


@pytest.mark.parametrize("name", PARSERS)
def test_parsers_refuse_paths_that_are_not_regular_files(name, odd):
    parse, error = PARSERS[name]
    with pytest.raises(error):
        parse(odd)


def test_paths_that_are_not_regular_files_are_not_opened(odd):
    assert not is_file(odd)
    with pytest.raises(OSError, match=r"instead of a file|too long"):
        open_file(odd)


def test_scene_lists_and_scene_marker_files_are_not_read_from_a_pipe(tmp_path):
    for name in ("train_list.txt", "scene.json"):
        os.mkfifo(tmp_path / name)
    assert read_list(tmp_path / "train_list.txt", ()) is None
    assert read_scene_file(tmp_path) is None


def test_a_symbolic_link_to_a_file_is_read_as_the_file(tmp_path):
    (tmp_path / "blob").write_bytes(b"content")
    (tmp_path / "name").symlink_to("blob")
    assert is_file(tmp_path / "name")
    assert read_file(tmp_path / "name") == b"content"


@pytest.mark.parametrize("name", ["json", "csv", "exposure", "camera path"])
def test_a_file_above_the_size_limit_is_not_read(name, tmp_path):
    path = tmp_path / "file"
    with path.open("wb") as file:
        file.truncate(1 << 42)  # takes no room
    parse, error = PARSERS[name]
    with pytest.raises(error, match="more than the limit of 64"):
        parse(path)


def test_a_huge_settings_file_is_refused_after_its_first_bytes(tmp_path):
    path = tmp_path / "run.yaml"
    with path.open("wb") as file:
        file.write(b"steps: 3\n")
        file.truncate(1 << 42)
    with pytest.raises(UserError, match=r"run\.yaml"):
        read_mapping(path, "the settings", "mend them")


@pytest.mark.parametrize("name", ["run.lock", "log.txt"])
def test_files_in_a_run_folder_are_not_written_through_a_link(name, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("not to be lost")
    run = tmp_path / "run"
    run.mkdir()
    (run / name).symlink_to(mine)

    def write():
        with locked(run, "testing"):
            RunLog(run).write("a line")

    with pytest.raises(UserError, match=r"mine\.txt"):
        write()
    (run / name).unlink()
    os.mkfifo(run / name)
    with pytest.raises(UserError, match="a pipe"):
        write()
    (run / name).unlink()
    write()
    assert mine.read_text() == "not to be lost"
