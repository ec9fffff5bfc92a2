"""Before the first step all that training needs is compiled, with a second process beside."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.numerics import kernel_cache
from crossgrad_core.run.bundled import bundled_scene
from crossgrad_core.training import compile_ahead

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


@pytest.mark.parametrize("length", [{"steps": 160}, {"seconds": 3.0}], ids=["steps", "seconds"])
def test_training_compiles_nothing_behind_the_warm_up(tmp_path, length):
    settings = {
        "scene": str(bundled_scene()),
        "reading": {"max_size": 48},
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
from crossgrad_core.training.compile_ahead import compile_all
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


def test_what_is_compiled_beside_is_what_a_run_uses():
    done = subprocess.run(
        [sys.executable, "-c", BESIDE], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    known, new = json.loads(done.stdout.splitlines()[-1])
    assert known >= 4
    assert new == []


@pytest.mark.parametrize(("settings", "processes"), [({}, 1), ({"threads": 1}, 0)])
def test_the_other_process_starts_with_the_first_missing_kernel(monkeypatch, settings, processes):
    started = []

    class Process:
        """Takes the command and the end of it."""

        def __init__(self, command, **options):
            started.append(command)

        def terminate(self):
            started.append("terminated")

        def wait(self):
            started.append("waited for")

    monkeypatch.setattr(compile_ahead.subprocess, "Popen", Process)
    monkeypatch.setattr(compile_ahead, "available_cores", lambda: 2)
    setup = SimpleNamespace(config=RunConfig(**settings), device=torch.device("cpu"))
    with compile_ahead.compiling_beside(setup):
        assert started == []
        for _ in range(2):
            for listener in kernel_cache._LISTENERS:
                listener()
    assert len(started) == 3 * processes
    assert kernel_cache._LISTENERS == []
    if processes:
        assert started[1:] == ["terminated", "waited for"]
        assert json.loads(started[0][-1]) == {"name": "l1-ssim"}
