"""A damaged file ends in the right result or in one error, and nothing is lost by it.

Every file that a fresh run, sweep or prepared scene has is damaged in every way, one at a time. A
file that is added later is among them by itself.
"""

import csv
import shutil
from contextlib import contextmanager

import pytest
from support.commands import ended
from support.damage import DAMAGES, cases, command, files_of
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.pictures import with_pictures, worst_views
from crossgrad_plugins.compare.tables import csv_tables

CLOCKS = {"train_seconds", "cpu_seconds", "peak_memory_mib"}
#: Another scene file, photo or setting makes other results, and the command says so.
TOLD = ("was edited since", "is restored as it was", "cannot be told", "is not the file that")

SLOW = pytest.mark.slow
THOROUGH = pytest.mark.parametrize(
    "thorough", [False, pytest.param(True, marks=SLOW)], ids=["short", "thorough"]
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9, folders=("a", "b"))


@pytest.fixture(scope="module")
def stopped(scene, tmp_path_factory):
    """A run that stopped between two of its evaluations."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    options = ("--steps", 8, "--stop-after", 5, "--eval-every", 3, "--save-every", 2)
    settings = ("--threads", 1, "--plan", "turns", "-q")
    assert ended("run", scene, "--out", out, *options, *settings) == 0
    return out


@pytest.fixture(scope="module")
def finished(stopped, tmp_path_factory):
    """The same run at its end."""
    out = shutil.copytree(stopped, tmp_path_factory.mktemp("finished") / "run")
    assert ended("run", "--resume", out, "-q") == 0
    return out


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(file)]


def results(run):
    """What must not change: figures, Gaussians and parameters."""
    newest = max((run / "checkpoints").glob("step-*"))
    return (
        rows(run / "metrics.csv"),
        rows(run / "per_view.csv"),
        (run / "point_cloud.ply").read_bytes(),
        newest.name,
        (newest / "tensors.safetensors").read_bytes(),
    )


def contents(folder):
    return {file: (folder / file).read_bytes() for file in files_of(folder)}


def damaged(whole, place, file, damage):
    shutil.rmtree(place, ignore_errors=True)
    copy = shutil.copytree(whole, place)
    DAMAGES[damage](copy / file)
    return copy


@THOROUGH
def test_a_run_goes_on_as_if_nothing_had_happened_or_not_at_all(
    stopped, finished, tmp_path, capsys, thorough
):
    wanted = results(finished)
    for file, damage in cases(files_of(stopped), thorough=thorough):
        run = damaged(stopped, tmp_path / "run", file, damage)
        before = contents(run)
        end = command(capsys, "run", "--resume", run)
        if end.code == 0:
            told = any(words in end.err for words in TOLD)
            assert results(run) == wanted or told, (file, damage, end)
        else:
            assert end.is_refused, (file, damage, end)
            assert contents(run) == before, (file, damage)


@THOROUGH
@pytest.mark.parametrize(
    "name", ["eval", pytest.param("export", marks=SLOW), pytest.param("render", marks=SLOW)]
)
def test_a_look_at_a_run_shows_what_it_is_or_nothing(finished, tmp_path, capsys, name, thorough):
    def looked(run):
        out = tmp_path / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        place = {"eval": (), "export": ("--out", out / "x.ply"), "render": ("--out", out)}[name]
        end = command(capsys, name, run, *place)
        return end, contents(out), end.out if name == "eval" else ""

    wanted = looked(shutil.copytree(finished, tmp_path / "whole"))
    assert wanted[0].code == 0
    for file, damage in cases(files_of(finished), thorough=thorough):
        run = damaged(finished, tmp_path / "run", file, damage)
        before = contents(run)
        found = looked(run)
        if found[0].code == 0:
            assert found[1:] == wanted[1:] or "was edited since" in found[0].err, (file, damage)
        else:
            assert found[0].is_refused, (file, damage, found)
            assert contents(run) == before, (file, damage)


@contextmanager
def allowed_refusal(file):
    """Let the block end in the error that names the file."""
    try:
        yield
    except UserError as error:
        if file.name not in str(error):
            raise


def compared_tables(folder):
    comparison = compared(read_runs([folder], skip_broken=False), Options())
    views = worst_views(comparison)
    with_pictures(comparison, views)
    return csv_tables(comparison, views)


@THOROUGH
def test_a_comparison_has_the_same_tables_or_is_refused(finished, tmp_path, thorough):
    runs = tmp_path / "runs"
    shutil.copytree(finished, runs / "other")
    config = runs / "other" / "config.yaml"
    summary = runs / "other" / "summary.json"
    (runs / "other" / "SHA256SUMS").unlink()
    for path, old, new in ((config, "seed: 0", "seed: 1"), (summary, '"seed": 0', '"seed": 1')):
        path.write_text(path.read_text().replace(old, new))
    shutil.copytree(finished, runs / "run")
    wanted = compared_tables(runs)
    for file, damage in cases(files_of(finished), thorough=thorough):
        damaged(finished, runs / "run", file, damage)
        with allowed_refusal(file):
            assert compared_tables(runs) == wanted, (file, damage)


@THOROUGH
def test_a_scene_is_the_one_that_was_trained_on_or_refused(
    scene, finished, tmp_path, capsys, thorough
):
    run = shutil.copytree(finished, tmp_path / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(str(scene), str(tmp_path / "scene")))
    shutil.copytree(scene, tmp_path / "scene")
    wanted = command(capsys, "eval", run)
    assert wanted.code == 0
    files = files_of(scene)
    for file, damage in cases(files if thorough else files[::5], thorough=thorough):
        damaged(scene, tmp_path / "scene", file, damage)
        found = command(capsys, "eval", run)
        assert found.is_refused or (found.code, found.out) == (0, wanted.out), (file, damage)
