"""`crossgrad plugins matrix` and the option of pytest: what is trained, refused and failed."""

import subprocess
import sys

import pytest

from crossgrad_core.commands import UserError
from crossgrad_core.registry.entries import load
from crossgrad_plugins.authoring.matrix import report
from crossgrad_plugins.authoring.matrix.combinations import default_row
from crossgrad_plugins.authoring.matrix.members import Members, members_of

NAMES = {
    "sampler": ("epoch", "near-far"),
    "operator": ("sum",),
    "backbone": ("vanilla",),
    "densifier": ("anchor", "none"),
    "rasterizer": ("torch",),
}
MINE = Members("mine 1.0", NAMES, frozenset({("backbone", "vanilla")}), ("sampler odd: is odd",))
CONFTEST = f"""
from crossgrad_plugins.authoring.matrix import members
mine = members.Members("mine 1.0", {NAMES!r}, frozenset({{("backbone", "vanilla")}}), ())
members.members_of = lambda package: mine
"""


@pytest.fixture
def mine(monkeypatch):
    monkeypatch.setattr(report, "members_of", lambda package: MINE)


def test_combinations_train_or_are_refused_with_the_reason(mine):
    text, passed = report.train_matrix("mine", full=False)
    assert passed
    assert "2 combinations trained for 5 steps" in text
    assert "densifier anchor edits the tensors" in " ".join(text.split())
    assert "left out: sampler odd: is odd" in text
    assert text.endswith("0 combinations failed")


def test_a_failure_is_reported_with_its_reason_and_a_command_that_repeats_it(mine, monkeypatch):
    def broken(self, context, state):
        raise ZeroDivisionError("no steps yet")

    monkeypatch.setattr(load("samplers", "near-far"), "sample", broken)
    text, passed = report.train_matrix("mine", full=True)
    assert not passed
    assert "1 combination failed" in text
    assert "ZeroDivisionError: no steps yet at " in " ".join(text.split())
    row = "sampler=near-far operator=sum backbone=vanilla densifier=none rasterizer=torch"
    assert f"crossgrad plugins matrix mine --only '{row}'" in text
    with pytest.raises(ZeroDivisionError):
        report.train_one("mine", row)


def test_a_component_refused_in_all_combinations_fails(monkeypatch):
    refused = Members("mine 1.0", {**NAMES, "densifier": ("anchor",)}, MINE.own, ())
    monkeypatch.setattr(report, "members_of", lambda package: refused)
    text, passed = report.train_matrix("mine", full=True)
    assert not passed
    assert "FAIL  backbone vanilla was not trained in any combination" in text


def test_an_unknown_combination_is_refused(mine):
    with pytest.raises(UserError, match="does not name a combination"):
        report.train_one("mine", "sampler=epoch operator=no-such-operator")


def test_the_error_for_an_unknown_package_names_the_installed_packages():
    with pytest.raises(UserError, match="crossgrad"):
        members_of("no-such-package")


def test_a_default_row_has_the_densifier_of_its_backbone():
    slots = tuple(NAMES)
    assert (
        default_row({"backbone": "scaffold"}, slots)[3]
        == load("backbones", "scaffold").default_densifier
    )
    assert default_row({"densifier": "none"}, slots)[3] == "none"


def run_pytest(folder, *arguments):
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-v", "-rs", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_pytest_option_adds_the_combinations_to_the_tests(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST)
    ended = run_pytest(tmp_path, "--crossgrad-matrix", "mine")
    assert ended.returncode == 0, ended.stdout
    assert "2 passed" in ended.stdout
    assert "refused before training: densifier anchor" in ended.stdout


@pytest.mark.slow
def test_the_pytest_option_reports_an_unknown_package(tmp_path):
    ended = run_pytest(tmp_path, "--crossgrad-matrix", "no-such-package")
    assert ended.returncode == pytest.ExitCode.USAGE_ERROR
    assert "no package named 'no-such-package' is installed" in ended.stderr + ended.stdout


def test_pytest_without_the_option_does_not_import_crossgrad():
    program = "import sys, crossgrad_plugins.authoring.pytest_plugin; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    assert not {"torch", "numpy", "crossgrad_core"} & set(done.stdout.split())
