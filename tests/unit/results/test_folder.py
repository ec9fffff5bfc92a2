"""The output folder: named after the run, new, and checked before any work is done."""

import os
from datetime import datetime
from pathlib import Path

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.folder import RunName, create_run_folder, expected_bytes
from crossgrad_core.run.results.lock import locked

STARTED = datetime(2026, 3, 5, 9, 8, 7).astimezone()
NAME = RunName("boruszyn", "vanilla", "near-far", "pcgrad", STARTED)


def test_a_run_folder_is_named_after_scene_method_and_time(tmp_path: Path):
    folder = create_run_folder(NAME, root=tmp_path)
    assert folder == tmp_path / "boruszyn" / "vanilla-near-far-pcgrad" / "20260305-090807"
    assert list(folder.iterdir()) == []


def test_runs_of_the_same_second_get_separate_folders(tmp_path: Path):
    names = [create_run_folder(NAME, root=tmp_path).name for _ in range(3)]
    assert names == ["20260305-090807", "20260305-090807-2", "20260305-090807-3"]


@pytest.mark.parametrize(
    ("scene", "expected"),
    [("a b/c", "a_b_c"), ("..", "_"), ("", "_"), ("Łódź 3", "Łódź_3"), ("x:y|z", "x_y_z")],
)
def test_every_scene_name_becomes_one_safe_path_component(
    tmp_path: Path, scene: str, expected: str
):
    folder = create_run_folder(RunName(scene, "b", "s", "o", STARTED), root=tmp_path)
    assert folder == tmp_path / expected / "b-s-o" / "20260305-090807"


@pytest.mark.parametrize("exists", [False, True])
def test_the_output_folder_may_be_new_or_empty(tmp_path: Path, exists: bool):
    out = tmp_path / "deep" / "out"
    if exists:
        out.mkdir(parents=True)
    assert create_run_folder(NAME, out=out) == out
    assert list(out.iterdir()) == []


def test_results_are_never_overwritten(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text("precious")
    with pytest.raises(UserError, match=r"never overwrites results(.|\n)*metrics\.csv") as caught:
        create_run_folder(NAME, out=tmp_path)
    assert (tmp_path / "metrics.csv").read_text() == "precious"
    # There is no run that could go on.
    assert "--resume" not in caught.value.todo
    (tmp_path / "config.yaml").touch()
    with pytest.raises(UserError, match="--resume"):
        create_run_folder(NAME, out=tmp_path)


def test_the_process_that_writes_into_the_folder_is_reported(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text("precious")
    with (
        locked(tmp_path, "training"),
        pytest.raises(UserError, match=rf"metrics\.csv of process {os.getpid()}, training since"),
    ):
        create_run_folder(NAME, out=tmp_path)


def test_temporary_files_of_a_killed_run_do_not_make_a_folder_occupied(tmp_path: Path):
    (tmp_path / ".config.yaml.4711.tmp").write_text("backb")
    with locked(tmp_path, "training"):
        pass
    assert create_run_folder(NAME, out=tmp_path) == tmp_path


def test_an_output_path_that_is_a_file_is_refused(tmp_path: Path):
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="is a file"):
        create_run_folder(NAME, out=tmp_path / "out")


def test_too_little_disk_space_is_reported_before_anything_is_created(tmp_path: Path):
    with pytest.raises(UserError, match=r"not enough disk space(.|\n)*GiB free"):
        create_run_folder(NAME, out=tmp_path / "out", needed=2**60)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_write_permission_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(dir: Path) -> None:  # noqa: A002 - the name of tempfile's own argument
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(UserError, match="cannot write to this path"):
        create_run_folder(NAME, out=tmp_path / "out")


def test_expected_size_covers_the_checkpoints_and_the_ply():
    one_million = expected_bytes(1_000_000, checkpoints=2)
    assert one_million == 4 * 1_000_000 * (3 * 3 * 59 + 62)
    assert expected_bytes(10, checkpoints=2) > 10**6
