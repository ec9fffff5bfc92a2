"""Files that appear complete or not at all."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import (
    atomic_file,
    atomic_folder,
    clear_leftovers,
    disk_errors,
    free_bytes,
    is_leftover,
    size_text,
    write_atomically,
)


def test_writing_replaces_the_whole_file(tmp_path: Path):
    path = tmp_path / "a.txt"
    write_atomically(path, b"old and long")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"]


def interrupted_write(path: Path) -> None:
    with atomic_file(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt


def test_an_error_inside_the_block_keeps_the_old_file(tmp_path: Path):
    path = tmp_path / "a.txt"
    write_atomically(path, b"old")
    with pytest.raises(KeyboardInterrupt):
        interrupted_write(path)
    assert path.read_bytes() == b"old"
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "not enough disk space"),
        (errno.EDQUOT, "not enough disk space"),
        (errno.EACCES, "cannot write to this path"),
        (errno.EROFS, "cannot write to this path"),
        (errno.EISDIR, "already has this name"),
        (errno.ENOTDIR, "already has this name"),
        (errno.EEXIST, "already has this name"),
        (errno.ELOOP, "already has this name"),
    ],
)
def test_disk_errors_become_user_errors(tmp_path: Path, number: int, message: str):
    with pytest.raises(UserError, match=message) as told, disk_errors(tmp_path / "x" / "y", 2**20):
        raise OSError(number, "as the system says it")
    assert str(tmp_path / "x" / "y") in str(told.value)


def test_other_system_errors_are_passed_on(tmp_path: Path):
    with pytest.raises(FileNotFoundError), disk_errors(tmp_path):
        (tmp_path / "a" / "b.txt").write_text("")


def test_a_folder_with_the_name_of_the_file_is_not_replaced(tmp_path: Path):
    (tmp_path / "a.txt").mkdir()
    with pytest.raises(UserError, match="already has this name"):
        write_atomically(tmp_path / "a.txt", b"new")
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0.0 KiB"), (3 * 2**9, "1.5 KiB"), (3 * 2**19, "1.5 MiB"), (2**30, "1.0 GiB")],
)
def test_sizes_are_printed_readably(count: int, text: str):
    assert size_text(count) == text


def test_free_space_is_found_for_a_folder_that_does_not_exist_yet(tmp_path: Path):
    assert free_bytes(tmp_path / "a" / "b") > 0


def test_temporary_files_of_a_killed_process_are_deleted(tmp_path: Path):
    with atomic_file(tmp_path / "a.png") as file:
        left = Path(file.name)
        assert is_leftover(left)
    left.write_bytes(b"half")
    (tmp_path / ".my.tmp").write_text("not ours")
    clear_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".my.tmp", "a.png"]


def test_temporary_files_of_living_processes_are_kept_in_a_shared_folder(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        dead.wait()
    names = [f".a.png.{number}.tmp" for number in (dead.pid, os.getpid(), os.getppid())]
    for name in names:
        (tmp_path / name).touch()
    clear_leftovers(tmp_path, shared=True)
    assert [path.name for path in tmp_path.iterdir()] == names[2:]
    clear_leftovers(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_name_that_is_too_long_is_a_user_error(tmp_path):
    with pytest.raises(UserError, match="the path is too long"):
        write_atomically(tmp_path / ("a" * 250), b"")


def test_a_folder_appears_as_a_whole_or_not_at_all(tmp_path: Path):
    def fail() -> None:
        with atomic_folder(tmp_path / "a") as folder:
            (folder / "part").write_bytes(b"1")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert not [*tmp_path.iterdir()]
    with atomic_folder(tmp_path / "a") as folder:
        (folder / "part").write_bytes(b"1")
        assert is_leftover(folder) and not (tmp_path / "a").exists()
    assert (tmp_path / "a" / "part").read_bytes() == b"1"
    with pytest.raises(UserError, match="already has this name"), atomic_folder(tmp_path / "a"):
        pass
    assert [item.name for item in tmp_path.iterdir()] == ["a"]


def test_a_left_over_folder_is_deleted(tmp_path: Path):
    folder = tmp_path / ".tiles.123456.tmp"
    folder.mkdir()
    (folder / "0.glb").touch()
    clear_leftovers(tmp_path)
    assert not [*tmp_path.iterdir()]
