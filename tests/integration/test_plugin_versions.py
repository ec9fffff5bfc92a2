"""A run goes on with the packages that it began with, or says what changed."""

import json
import sys

import pytest
from support.commands import ended
from support.distributions import write_distribution
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.run.results.plugins_file import FILE

SOURCE = """
from crossgrad_core.registry.entries import load

class Own(load("operators", "sum")):
    pass

class Project(load("operators", "pcgrad")):
    pass

class Model(load("backbones", "vanilla")):
    pass
"""
PLUGINS = {
    "operators": {"own-sum": "made_up_versions:Own", "own-pcgrad": "made_up_versions:Project"},
    "backbones": {"own-vanilla": "made_up_versions:Model"},
}
GIVEN = ("--steps", "6", "--stop-after", "2", "--threads", "1", "-q")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a version of the package in place of the one before; None removes it."""

    def put(version):
        for known in [each for each in sys.path if each.startswith(str(tmp_path / "site"))]:
            sys.path.remove(known)
        sys.modules.pop("made_up_versions", None)
        if version is not None:
            folder = tmp_path / f"site-{version}"
            modules = {"made_up_versions": SOURCE}
            if not folder.exists():
                write_distribution(folder, "versioned-package", PLUGINS, modules, version)
            sys.path.insert(0, str(folder))

    monkeypatch.setattr(sys, "path", list(sys.path))
    yield put
    sys.modules.pop("made_up_versions", None)


@pytest.fixture
def stopped(scene, tmp_path, install):
    """A run that version 1.0 of the package began."""
    install("1.0")
    run = tmp_path / "run"
    assert ended("run", scene, *GIVEN, "--operator", "own-sum", "--out", run) == 0
    return run


def packages(run):
    return json.loads((run / FILE).read_text())


def contents(run):
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_a_run_records_its_packages_and_their_components(scene, tmp_path, stopped):
    assert packages(stopped) == {
        "crossgrad": {"versions": [cg.__version__], "components": []},
        "versioned-package": {"versions": ["1.0"], "components": ["operator own-sum"]},
    }
    inside = tmp_path / "inside"
    rules = "operator.rules={geometry: own-pcgrad}"
    given = ("--operator", "dispatch", "--set", rules, "--views", "2", "--out", inside)
    assert ended("run", scene, *GIVEN, *given) == 0
    assert packages(inside)["versioned-package"]["components"] == ["operator own-pcgrad"]


def test_another_package_version_must_be_accepted_and_is_then_recorded(stopped, install, capsys):
    before = contents(stopped)
    install("1.1")
    assert ended("run", "--resume", stopped, "-q") == 2
    told = capsys.readouterr().err
    assert "expected: versioned-package 1.0\n" in told
    assert "found:    versioned-package 1.1\n" in told
    assert "--accept-plugins" in told
    assert contents(stopped) == before
    assert ended("run", "--resume", stopped, "--accept-plugins", "--stop-after", "4", "-q") == 0
    assert packages(stopped)["versioned-package"]["versions"] == ["1.0", "1.1"]
    note = "trained with versioned-package 1.0, then 1.1 (--accept-plugins): operator own-sum"
    assert signed(stopped) == [note]
    # The version that was accepted is the run's own from here on, and the note stays.
    run = cg.resume(stopped, quiet=True)
    assert run.summary["status"] == "finished"
    assert signed(stopped) == [note]


def signed(run):
    """The notes of a run that name the package."""
    notes = json.loads((run / "summary.json").read_text())["notes"]
    return [note for note in notes if "versioned-package" in note]


def test_a_run_with_unchanged_package_versions_is_resumed_without_a_message(stopped, capsys):
    assert ended("run", "--resume", stopped, "-q") == 0
    assert "version" not in capsys.readouterr().err
    assert signed(stopped) == ["from versioned-package 1.0: operator own-sum"]


def test_another_version_of_crossgrad_must_be_accepted_like_another_plugin_version(stopped, capsys):
    text = (stopped / FILE).read_text().replace(cg.__version__, "0.1.9")
    (stopped / FILE).write_text(text)
    with pytest.raises(cg.UserError, match=r"crossgrad 0\.1\.9(.|\n)*--accept-plugins"):
        cg.resume(stopped, quiet=True)
    cg.resume(stopped, quiet=True, accept_plugins=True)
    assert packages(stopped)["crossgrad"]["versions"] == ["0.1.9", cg.__version__]


def test_eval_reports_a_changed_package_version(stopped, install, capsys):
    install("1.1")
    assert ended("eval", stopped) == 0
    words = (
        "the run was trained with versioned-package 1.0; "
        "the installed version is versioned-package 1.1"
    )
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_without_a_readable_package_file_is_resumed_with_a_note(stopped, capsys):
    for content in (None, "{", '{"crossgrad": {"versions": []}}', "[1]"):
        (stopped / FILE).unlink()
        if content is not None:
            (stopped / FILE).write_text(content)
        step = str(packages_before(stopped))
        assert ended("run", "--resume", stopped, "--stop-after", step, "-q") == 0
        assert (
            capsys.readouterr().err.count("whether the plugins of the run are still the same") == 1
        )
        assert packages(stopped)["versioned-package"]["versions"] == ["1.0"]


def packages_before(run):
    """The step after the newest checkpoint."""
    return json.loads((run / "summary.json").read_text())["step"] + 1


def test_a_missing_package_is_named_with_its_version(scene, tmp_path, stopped, install, capsys):
    whole = tmp_path / "whole"
    assert ended("run", scene, *GIVEN, "--backbone", "own-vanilla", "--out", whole) == 0
    install(None)
    before = contents(whole)
    for command in (("run", "--resume", stopped), ("run", "--resume", whole, "--accept-plugins"),
                    ("eval", whole), ("render", whole), ("export", whole)):  # fmt: skip
        assert ended(*command) == 2
        told = capsys.readouterr().err
        assert "of versioned-package" in told
        assert "found:    package versioned-package is not installed" in told
        assert "pip install versioned-package==1.0" in told
    assert contents(whole) == before


def test_accepting_plugins_needs_a_run_to_continue(scene, capsys):
    assert ended("run", scene, "--accept-plugins") == 2
    assert "--accept-plugins" in capsys.readouterr().err
