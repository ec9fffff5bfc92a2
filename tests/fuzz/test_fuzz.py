"""A short search on every parser, the inputs on which one once failed, and the defects put back.

The long searches are `make fuzz`.
"""

import os
import re
import subprocess
import sys
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import pytest
from crossgrad_fuzz.defects import DEFECTS
from crossgrad_fuzz.law import Bench
from crossgrad_fuzz.loop import Budget, search
from crossgrad_fuzz.regressions import REGRESSIONS, known_of
from crossgrad_fuzz.targets import TARGETS

MAKEFILE = Path(__file__).parents[2] / "Makefile"
#: Executions of each short search: about ten seconds for all parsers.
SHORT = 25
#: Of a search for a defect that begins with the inputs on which parsers once failed.
DIRECT = 60


def told(found) -> str:
    return "\n\n".join(f"{kind}\n{what.detail}\n{case}" for kind, (what, case) in found.items())


@pytest.mark.sampled(10)
@pytest.mark.parametrize("name", TARGETS)
def test_a_short_fuzz_search_finds_no_defect(name, tmp_path):
    target = TARGETS[name]
    found = search(target, Bench(target, tmp_path / "bench"), Budget(executions=SHORT), seed=0)
    assert not found.findings, told(found.findings)
    assert found.executions >= SHORT


@pytest.mark.parametrize(
    ("target", "name"), [(target, name) for target, cases in REGRESSIONS.items() for name in cases]
)
def test_inputs_that_once_failed_now_pass(target, name, tmp_path):
    seeds = TARGETS[target].seeds()
    bench = Bench(TARGETS[target], tmp_path / "bench")
    bench.warm_up(seeds)
    finding = bench.execute(REGRESSIONS[target][name](seeds))
    assert finding is None, finding.detail


@pytest.mark.parametrize("name", DEFECTS)
def test_the_search_finds_a_reintroduced_defect(name, tmp_path):
    # What takes too long is known after a quarter of a second here.
    target = replace(TARGETS[DEFECTS[name].target], seconds=0.25)
    bench = Bench(target, tmp_path / "bench")
    bench.warm_up(target.seeds())
    with DEFECTS[name].put_back():
        budget = Budget(executions=DIRECT, findings=1, shrinking=0)
        found = search(target, bench, budget, 0, known_of(target.name))
    assert found.findings


def test_functions_excluded_from_a_search_exist():
    unknown = [
        f"{target}: {module.__name__}.{name}"
        for target, parser in ((name, found.parser) for name, found in TARGETS.items())
        for module, names in parser.items()
        for name in names
        if not _has(module, name)
    ]
    assert not unknown


def _has(module, name):
    try:
        attrgetter(name)(module)
    except AttributeError:
        return False
    return True


@pytest.mark.slow
def test_the_makefile_runs_the_fuzz_search():
    (path,) = set(re.findall(r"PYTHONPATH=(\S+) .*-m crossgrad_fuzz", MAKEFILE.read_text()))
    arguments = [sys.executable, "-m", "crossgrad_fuzz", "--help"]
    environment = os.environ | {"PYTHONPATH": path}
    subprocess.run(arguments, cwd=MAKEFILE.parent, env=environment, check=True)
