"""The lock on a run's folder: one process at a time, gone with its process however that ends."""

import errno
import fcntl
import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.run.postprocess.output_paths import writing_if_possible
from crossgrad_core.run.results.lock import FILE, RunInUseError, locked, writer_of

HOLD = """
import sys, time
from pathlib import Path
from crossgrad_core.run.results.lock import locked
with locked(Path(sys.argv[1]), "training"):
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that has locked the folder."""
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_with_the_holder_and_its_start_time(tmp_path, holder):
    with pytest.raises(RunInUseError) as told, locked(tmp_path, "training"):
        pass
    message = str(told.value)
    assert f"process {holder.pid}, training since 20" in message
    assert str(tmp_path) in message and "wait until the process ends" in message
    assert writer_of(tmp_path) in message


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_lock_of_a_run_folder_ends_with_its_process(tmp_path, holder, number):
    os.kill(holder.pid, number)
    holder.wait()
    assert (tmp_path / FILE).is_file()
    assert writer_of(tmp_path) is None
    with locked(tmp_path, "training") as held:
        assert held


def test_a_second_lock_in_the_same_process_is_refused_until_the_block_ends(tmp_path):
    with locked(tmp_path, "training"):
        with pytest.raises(RunInUseError, match=f"process {os.getpid()}"), locked(tmp_path, "x"):
            pass
        assert writer_of(tmp_path).startswith(f"process {os.getpid()}, training since")
    assert writer_of(tmp_path) is None
    assert (tmp_path / FILE).read_bytes() == b""
    with locked(tmp_path, "training") as held:
        assert held


def test_a_lock_whose_holder_has_not_written_its_name_is_respected(tmp_path):
    with (tmp_path / FILE).open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RunInUseError, match="a process that holds"), locked(tmp_path, "x"):
            pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL])
def test_a_run_continues_if_the_file_system_has_no_locks(tmp_path, monkeypatch, number):
    def unsupported(file, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with locked(tmp_path, "training") as held:
        assert not held
    assert writer_of(tmp_path) is None


class FullDisk(io.FileIO):
    """A file of which nothing more can be written."""

    def write(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_is_reported_once(tmp_path, monkeypatch):
    def opened(descriptor, mode, buffering=-1):
        file = FullDisk(descriptor, mode)
        return file if buffering == 0 else io.BufferedRandom(file)

    monkeypatch.setattr(os, "fdopen", opened)
    with pytest.raises(UserError, match="not enough disk space"), locked(tmp_path, "exporting"):
        pass
    with writing_if_possible(tmp_path, "evaluating") as writes:
        assert not writes


def test_a_folder_without_write_permission_is_refused(tmp_path: Path, monkeypatch):
    def refuse(*args):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(UserError, match="cannot write to this path"), locked(tmp_path, "training"):
        pass
