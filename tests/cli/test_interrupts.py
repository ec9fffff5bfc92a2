"""Signals end a command with one line and 128 plus their number, whatever is going on."""

import os
import signal
import subprocess
import sys

import pytest

#: Sends itself a signal when a module is about to be imported, or when a line has been written.
PROGRAM = """
import os, runpy, signal, sys

ALL = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
number, moment = int(sys.argv[1]), sys.argv[2]
for each in ALL:
    # A test runner in the background may have handed down that they are ignored.
    signal.signal(each, signal.default_int_handler if each == signal.SIGINT else signal.SIG_DFL)

class Importing:
    def find_spec(self, name, path=None, target=None):
        if name == moment:
            os.kill(os.getpid(), number)

class Writing:
    def __init__(self, stream):
        self.stream = stream

    def write(self, text):
        self.stream.write(text)
        if moment in text:
            os.kill(os.getpid(), number)

    def __getattr__(self, name):
        return getattr(self.stream, name)

sys.meta_path.insert(0, Importing())
sys.stderr = Writing(sys.stderr)
sys.argv[1:] = sys.argv[3:]
runpy.run_module("crossgrad_core", run_name="__main__", alter_sys=True)
"""


def ended(number, moment, *arguments, **options):
    command = [sys.executable, "-c", PROGRAM, str(int(number)), moment, *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=120, **options
    )
    return done.returncode, done.stderr.splitlines()


LOADING = "loading libraries"


@pytest.mark.parametrize(
    ("number", "moment", "last"),
    [
        (signal.SIGINT, "crossgrad_core.cli.main", "interrupted"),
        (signal.SIGINT, "typer", "interrupted"),
        (signal.SIGTERM, "typer.main", "ended by SIGTERM"),
        (signal.SIGHUP, LOADING, "ended by SIGHUP"),
        (signal.SIGINT, "numpy", "interrupted"),
        (signal.SIGINT, "torch._C", "interrupted"),
        (signal.SIGTERM, "pydantic", "ended by SIGTERM"),
        (signal.SIGINT, "numba.core.typing", "interrupted"),
        (signal.SIGINT, "reading scene", "interrupted"),
    ],
)
def test_before_a_run_begins(number, moment, last, tmp_path):
    code, lines = ended(number, moment, "run", cwd=tmp_path)
    assert code == 128 + number
    assert lines[-1] == last
    assert len(lines) <= 3 and "Traceback" not in lines
    assert not list(tmp_path.iterdir())


def test_what_is_ignored_stays_ignored():
    ignoring = "signal.signal(number, signal.SIG_IGN)\nfor each in ():\n   "
    program = PROGRAM.replace("for each in ALL:", ignoring)
    command = [sys.executable, "-c", program, str(int(signal.SIGHUP)), "typer", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_files_that_are_being_written_do_not_stay(tmp_path):
    program = (
        "import os, pathlib, signal, sys\n"
        "from crossgrad_core.files import atomic_file\n"
        "from crossgrad_core.interrupts import ended_quietly\n"
        "with ended_quietly(), atomic_file(pathlib.Path(sys.argv[1])) as file:\n"
        "    file.write(b'half')\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "whole")],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (128 + signal.SIGTERM, "ended by SIGTERM\n")
    assert not list(tmp_path.iterdir())


def test_a_reader_that_is_gone_changes_neither_end_nor_code(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", PROGRAM, str(int(signal.SIGINT)), "typer", "run"]
    done = subprocess.run(command, stderr=writing, check=False, timeout=60, cwd=tmp_path)
    os.close(writing)
    assert done.returncode == 128 + signal.SIGINT
