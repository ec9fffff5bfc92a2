"""SHA256SUMS: what is listed is checked, and what a command replaces is listed anew."""

import shutil
import subprocess

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.system.checksums import (
    SUMS,
    changed_files,
    check_unchanged,
    relisted,
    warn_if_changed,
    write_checksums,
)


@pytest.fixture(name="folder")
def _folder(tmp_path):
    (tmp_path / "b").mkdir()
    for name in ("a.txt", "b/ż.txt", "c.txt"):
        (tmp_path / name).write_text(name)
    write_checksums(tmp_path, [tmp_path / "a.txt", tmp_path / "b" / "ż.txt"])
    return tmp_path


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="no sha256sum")
def test_the_program_sha256sum_accepts_the_file(folder):
    subprocess.run(["sha256sum", "--check", "--strict", SUMS], cwd=folder, check=True)


def test_a_changed_or_missing_file_is_named(folder):
    assert changed_files(folder) == []
    (folder / "a.txt").write_text("A.txt")
    (folder / "b" / "ż.txt").unlink()
    (folder / "c.txt").unlink()
    assert changed_files(folder) == ["a.txt", "b/ż.txt"]
    with pytest.raises(UserError, match=r"a\.txt has changed since crossgrad wrote it") as told:
        check_unchanged(folder, ["c.txt", "a.txt"], "restore it")
    assert told.value.todo == f"restore it; or remove {SUMS} to accept the file as it is"
    (folder / SUMS).unlink()
    check_unchanged(folder, ["a.txt"], "")


def test_checksums_are_updated_for_files_that_a_command_replaces(folder):
    with relisted(folder, "b", "c.txt"):
        assert changed_files(folder) == []
        (folder / "b" / "ż.txt").write_text("new")
        (folder / "b" / "d.txt").write_text("new")
    assert changed_files(folder) == []
    for name in ("b/ż.txt", "b/d.txt", "c.txt"):
        (folder / name).write_text("damage")
    assert changed_files(folder) == ["b/d.txt", "b/ż.txt", "c.txt"]


def test_a_folder_without_checksums_gets_no_checksum_file(tmp_path):
    with relisted(tmp_path, "a.txt"):
        (tmp_path / "a.txt").touch()
    assert not (tmp_path / SUMS).exists()


@pytest.mark.parametrize("line", ["0123  a.txt", "no line", "g" * 64 + "  a.txt"])
def test_a_damaged_checksum_file_is_an_error(folder, line):
    (folder / SUMS).write_text(f"{line}\n")
    with pytest.raises(UserError, match="SHA256SUMS cannot be read"):
        changed_files(folder)


def test_a_file_changed_by_another_program_is_used_with_a_warning(folder, caplog):
    warn_if_changed(folder / "a.txt")
    assert not caplog.text
    (folder / "a.txt").write_text("edited")
    warn_if_changed(folder / "a.txt")
    assert "has changed since its run wrote it" in caplog.text
