"""Before the first step all that training needs is compiled: no budget pays for compilers."""

import json
import subprocess
import sys

import pytest

from crossgrad_core.run.bundled import bundled_scene

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


@pytest.mark.parametrize("length", [{"steps": 640}, {"seconds": 3.0}], ids=["steps", "seconds"])
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
