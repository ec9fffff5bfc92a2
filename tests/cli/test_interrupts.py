"""Signals end a command with one line and 128 plus their number, whatever is going on."""

import json
import os
import signal
import subprocess
import sys

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.training.loop import _WORDS

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


@pytest.mark.sampled(3)
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
def test_a_signal_before_a_run_begins_ends_with_one_message(number, moment, last, tmp_path):
    code, lines = ended(number, moment, "run", cwd=tmp_path)
    assert code == 128 + number
    assert lines[-1] == last
    assert len(lines) <= 3 and "Traceback" not in lines
    assert not list(tmp_path.iterdir())


def test_an_ignored_signal_is_still_ignored():
    ignoring = "signal.signal(number, signal.SIG_IGN)\nfor each in ():\n   "
    program = PROGRAM.replace("for each in ALL:", ignoring)
    command = [sys.executable, "-c", program, str(int(signal.SIGHUP)), "typer", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_signal_leaves_no_partly_written_file(tmp_path):
    program = (
        "import os, pathlib, signal, sys\n"
        "from crossgrad_core.system.files import atomic_file\n"
        "from crossgrad_core.system.interrupts import ended_quietly\n"
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


def test_a_closed_stderr_does_not_change_the_exit_code(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", PROGRAM, str(int(signal.SIGINT)), "typer", "run"]
    done = subprocess.run(command, stderr=writing, check=False, timeout=60, cwd=tmp_path)
    os.close(writing)
    assert done.returncode == 128 + signal.SIGINT


#: Runs the command once for each case, in processes that are forked off when all is imported, and
#: sends a signal when functions are called, one after the other. Compiling takes no part.
FORKING = """
import importlib, json, os, signal, sys, threading

from pathlib import Path

import matplotlib.pyplot, numba, scipy.spatial, skimage.metrics, torch
from crossgrad_core import __main__ as command
from crossgrad_core.evaluation import evaluation
from crossgrad_core.numerics import kernel_cache
from crossgrad_core.run import app, session
from crossgrad_core.run.results import curve, panels
from crossgrad_plugins.losses.photometric.numba_kernels import fused
from crossgrad_plugins.rasterizers.numba_kernels import frame

def trap(number, moments):
    def sprung(place, function):
        def call(*args, **kwargs):
            if moments and moments[0] == place:
                del moments[0]
                os.kill(os.getpid(), number)
            return function(*args, **kwargs)
        return call
    for place in moments:
        path, _, name = place.rpartition(".")
        module, _, kind = path.partition(":")
        holder = importlib.import_module(module)
        holder = getattr(holder, kind) if kind else holder
        setattr(holder, name, sprung(place, getattr(holder, name)))

# What each fork would do again.
numba.njit("int64()")(lambda: 1)
for module in (frame, fused):
    kernel_cache.fingerprint(Path(module.__file__))

app.warm_up = lambda *_: 0.0
session.draw_curve = lambda *_: None
assert threading.active_count() == 1
for folder, number, moments, arguments in json.loads(sys.argv[1]):
    if (child := os.fork()) == 0:
        os.chdir(folder)
        for stream, name in ((1, "out.txt"), (2, "err.txt")):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY), stream)
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_DFL)
        trap(number, moments)
        sys.argv[1:] = arguments
        command.main()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
OPTIONS = ["--steps", "2", "--eval-every", "2", "--out", "a run"]
WAY_ON = "continue with: crossgrad run --resume 'a run'"
STOPPING, SAVING = _WORDS
STEP = "crossgrad_core.training.loop.take_step"
OPTIMIZE = "crossgrad_core.training.step._optimize"
SESSION = "crossgrad_core.run.session:Session."
#: Signal, calls at which it is sent, what is said, steps in the summary, whether there are results.
CASES = {
    "before the folder": (signal.SIGINT, ["crossgrad_core.run.app._new_folder"],
                          ["interrupted"], None, False),
    "before the first step": (signal.SIGINT, [SESSION + "__init__"],
                              ["interrupted", WAY_ON], None, False),
    "in a step": (signal.SIGTERM, [STEP],
                  [STOPPING, "run stopped", WAY_ON], 1, True),
    "twice in a step": (signal.SIGINT, [STEP, OPTIMIZE],
                        [STOPPING, SAVING, "run stopped", WAY_ON], 0, False),
    "in the evaluation": (signal.SIGINT, [STEP, SESSION + "evaluate"],
                          [STOPPING, SAVING, "run stopped", WAY_ON], 1, False),
    "in the export of a complete run": (signal.SIGINT, [SESSION + "export"],
                                        [STOPPING], 2, True),
    "thrice": (signal.SIGINT, [STEP, OPTIMIZE, SESSION + "align"],
               [STOPPING, SAVING, "interrupted", WAY_ON], None, False),
}  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folder and exit code of each case."""
    scene = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(scene, views=5)
    folders = [tmp_path_factory.mktemp("run") for _ in CASES]
    arguments = ["run", str(scene), *OPTIONS]
    cases = [
        (str(folder), int(number), moments, arguments)
        for folder, (number, moments, *_) in zip(folders, CASES.values(), strict=True)
    ]
    command = [sys.executable, "-c", FORKING, json.dumps(cases)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=250)
    return dict(zip(CASES, zip(folders, map(int, done.stdout.split()), strict=True), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_signal_in_a_run_gives_the_expected_messages_and_exit_code(runs, case):
    number, _, words, step, results = CASES[case]
    folder, code = runs[case]
    lines = (folder / "err.txt").read_text().splitlines()
    said = {STOPPING, SAVING, "run stopped", "interrupted", WAY_ON}
    assert code == 128 + number
    assert [line for line in lines if line in said] == words
    assert "Traceback" not in "".join(lines)
    assert lines[-1] == words[-1]
    if step is not None:
        summary = json.loads((folder / "a run" / "summary.json").read_text())
        assert (summary["status"], summary["step"]) == (
            "stopped" if WAY_ON in words else "finished",
            step,
        )
    assert (folder / "a run" / "point_cloud.ply").exists() == results
    assert not list(folder.rglob("*.tmp"))
