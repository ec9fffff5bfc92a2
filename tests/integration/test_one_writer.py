"""A run's folder has one writer: a second one is refused before it has changed anything."""

import os
from pathlib import Path

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.results.lock import locked


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=5)


@pytest.fixture(scope="module")
def stopped(scene, tmp_path_factory):
    """A run that can be continued."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    settings = {"scene": str(scene), "out": str(out), "steps": 4, "stop_after": 2}
    assert app.run(settings, verbosity=-1) == 0
    return out


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_running_run_cannot_be_resumed_a_second_time(stopped):
    with locked(stopped, "training"):
        before = content(stopped)
        with pytest.raises(UserError, match=f"process {os.getpid()}, training since"):
            app.run({}, resume=stopped, verbosity=-1)
        assert content(stopped) == before


def test_a_second_run_into_the_folder_of_a_run_that_just_began_is_refused(scene, tmp_path):
    settings = {"scene": str(scene), "out": str(tmp_path / "run"), "steps": 2}
    (tmp_path / "run").mkdir()
    with locked(tmp_path / "run", "training"):
        before = content(tmp_path / "run")
        with pytest.raises(UserError, match=f"process {os.getpid()}, training since"):
            app.run(settings, verbosity=-1)
        assert content(tmp_path / "run") == before


def test_a_folder_that_was_filled_during_compilation_is_refused(scene, tmp_path, monkeypatch):
    out = tmp_path / "run"

    def another_run_comes_and_goes(*args):
        out.mkdir()
        (out / "metrics.csv").write_text("precious")
        return 0.0

    monkeypatch.setattr(app, "warm_up", another_run_comes_and_goes)
    with pytest.raises(UserError, match="never overwrites results"):
        app.run({"scene": str(scene), "out": str(out), "steps": 2}, verbosity=-1)
    assert (out / "metrics.csv").read_text() == "precious"


def test_a_folder_that_is_not_a_run_gets_no_lock_file(tmp_path):
    with pytest.raises(UserError, match="not the folder of a run"):
        app.run({}, resume=tmp_path, verbosity=-1)
    assert content(tmp_path) == {}


def test_a_run_warns_if_the_file_system_has_no_locks(stopped, monkeypatch, caplog):
    import fcntl

    def unsupported(file, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    assert app.run({}, resume=stopped, verbosity=-1) == 0
    assert "does not support locks" in caplog.text
