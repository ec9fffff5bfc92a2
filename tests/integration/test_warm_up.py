"""All kernels are compiled before the first step, with the help of a second process."""

import json
import subprocess
import sys
from types import SimpleNamespace
from typing import ClassVar

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.numerics import kernel_cache
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.training import budget, start

#: Trains as the command does, and prints which kernels were compiled or loaded after the warm-up.
SCRIPT = """
import json, sys
from numba.core.dispatcher import Dispatcher
import crossgrad_core.run.app as app

def kernels():
    modules = [m for name, m in sorted(sys.modules.items()) if name.startswith("crossgrad")]
    found = {each for module in modules for each in vars(module).values()
             if isinstance(each, Dispatcher)}
    return {(f.py_func.__module__, f.py_func.__name__, str(s)) for f in found for s in f.signatures}

before, warm_up = set(), app.warm_up

def warmed(*arguments):
    seconds = warm_up(*arguments)
    before.update(kernels())
    return seconds

app.warm_up = warmed
assert app.run(json.loads(sys.argv[1]), verbosity=-1) == 0
assert len(before) > 10, len(before)
print(json.dumps(sorted(kernels() - before)))
"""


@pytest.mark.slow
@pytest.mark.parametrize("length", [{"steps": 160}, {"seconds": 3.0}], ids=["steps", "seconds"])
def test_training_compiles_no_kernel_after_the_warm_up(tmp_path, length):
    settings = {
        "scene": str(bundled_scene()),
        "data": {"max_size": 48},
        "out": str(tmp_path / "run"),
        "eval_every": 10_000,
        **length,
    }
    command = [sys.executable, "-c", SCRIPT, json.dumps(settings)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []


#: What the process beside compiles, then what the same loss and steps of a run use.
BESIDE = """
import json, sys
from numba.core.dispatcher import Dispatcher
from crossgrad_core.config import ComponentChoice
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.run.assemble import assemble
from crossgrad_core.commands import configured
from crossgrad_core.training.start import compile_all
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

def kernels():
    modules = [m for name, m in sorted(sys.modules.items())
               if name.startswith(("crossgrad_core.training.adam", "crossgrad_plugins.losses"))]
    found = {each for module in modules for each in vars(module).values()
             if isinstance(each, Dispatcher)}
    return {(f.py_func.__name__, str(s)) for f in found for s in f.signatures}

compile_all(ComponentChoice(name="l1-ssim"))
before = kernels()
setup = assemble(configured({"steps": 9}), sample_scene(), "none")
state = first_state(setup)
for _ in range(3):
    timed_step(setup, state)
print(json.dumps([len(before), sorted(kernels() - before)]))
"""


@pytest.mark.slow
def test_the_helper_process_compiles_every_kernel_that_a_run_uses():
    done = subprocess.run(
        [sys.executable, "-c", BESIDE], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    known, new = json.loads(done.stdout.splitlines()[-1])
    assert known >= 4
    assert new == []


class _Process:
    """Takes the command and the end of it."""

    started: ClassVar[list[str]] = []
    hangs: ClassVar[bool] = False

    def __init__(self, command, **options):
        self.started.append(command[-1])

    def terminate(self):
        self.started.append("terminated")

    def wait(self, timeout=None):
        self.started.append("waited for")
        if self.hangs and timeout is not None:
            raise subprocess.TimeoutExpired("compile", timeout)


@pytest.fixture
def started(monkeypatch):
    """What becomes of the other process, on a machine of two cores."""
    monkeypatch.setattr(start.subprocess, "Popen", _Process)
    monkeypatch.setattr(start, "available_cores", lambda: 2)
    monkeypatch.setattr(_Process, "started", [])
    return _Process.started


def _setup(**settings):
    return SimpleNamespace(config=RunConfig(**settings), device=torch.device("cpu"), sparse_rows={})


def _miss(*, kept=True):
    for listener in kernel_cache._LISTENERS:
        listener(kept=kept)


def test_the_helper_process_starts_with_the_first_missing_kernel(started):
    with start.compiling_beside(_setup()):
        assert started == []
        _miss()
        _miss()
        assert [json.loads(each) for each in started] == [{"name": "l1-ssim"}]
    # It is not ended before it is ready.
    assert started[1:] == ["waited for", "terminated", "waited for"]
    assert kernel_cache._LISTENERS == []


def test_a_helper_process_that_hangs_is_terminated(started, monkeypatch):
    monkeypatch.setattr(_Process, "hangs", True)
    with start.compiling_beside(_setup()):
        _miss()
    assert started[1:] == ["waited for", "terminated", "waited for"]


def test_the_helper_process_ends_with_a_run_that_is_refused(started):
    def refuse():
        with start.compiling_beside(_setup()):
            _miss()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refuse()
    assert started[1:] == ["terminated", "waited for"]


@pytest.mark.parametrize(("settings", "kept"), [({"threads": 1}, True), ({}, False)])
def test_no_helper_process_starts_without_a_free_core_or_a_kernel_cache(started, settings, kept):
    with start.compiling_beside(_setup(**settings)):
        _miss(kept=kept)
    assert started == []


def test_kernels_for_sparse_rows_are_compiled_before_the_first_step_if_a_block_uses_them(
    monkeypatch,
):
    # Whether a view draws few rows is found out on the clock.
    asked = []
    monkeypatch.setattr(start, "compile_rows", lambda: asked.append("rows"))
    for sparse_rows in ({}, {"sh_rest": "f_rest"}):
        setup = _setup(threads=1)
        setup.sparse_rows = sparse_rows
        with start.compiling_beside(setup):
            assert asked == []
    assert asked == ["rows"]


def test_a_speed_probe_restarts_after_a_kernel_was_compiled(monkeypatch):
    clock = SimpleNamespace(seconds=0.0)
    clock.trained = lambda kind: clock.seconds
    clock.copy = lambda: SimpleNamespace(trained=lambda kind, at=clock.seconds: at)
    state = SimpleNamespace(step=0, clock=clock)
    setup = SimpleNamespace(
        config=SimpleNamespace(clock="wall"),
        schedule=SimpleNamespace(pace=SimpleNamespace(views=lambda step: 2 * step)),
    )
    taken = []

    def step(setup, state):
        state.step += 1
        taken.append(state.step)
        clock.seconds += 0.1
        if len(taken) in (3, 9):
            clock.seconds += 5.0
            _miss(kept=False)

    monkeypatch.setattr(budget, "timed_step", step)
    steps, each = budget._probed(setup, state, seconds=10.0)
    assert steps == budget.PROBE_STEPS
    # Always the first ones: later ones may draw more pixels.
    assert set(taken) == {*range(1, 1 + budget.PROBE_STEPS)}
    assert len(taken) == 9 + budget.PROBE_STEPS
    assert 2 * each == pytest.approx(0.1)


def test_a_speed_probe_ends_after_a_limit_if_every_step_compiles(monkeypatch):
    clock = SimpleNamespace(trained=lambda kind: 1.0, copy=lambda: clock)
    state = SimpleNamespace(step=0, clock=clock)
    pace = SimpleNamespace(views=lambda step: step)
    setup = SimpleNamespace(
        config=SimpleNamespace(clock="wall"), schedule=SimpleNamespace(pace=pace)
    )

    def step(setup, state):
        state.step += 1
        _miss()

    monkeypatch.setattr(budget, "timed_step", step)
    assert budget._probed(setup, state, seconds=0.0)[0] == budget.PROBE_STEPS
