"""A damaged file ends in the right result or in one error, and nothing is lost by it.

Every file that a fresh run, sweep or prepared scene has is damaged in every way, one at a time. A
file that is added later is among them by itself.
"""

import csv
import json
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image
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
TOLD = ("was edited after", "is restored to", "it is not known", "has changed since its run")

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
    settings = ("--threads", 1, "-q")
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


@pytest.mark.slow
@THOROUGH
def test_resuming_a_damaged_run_gives_the_same_results_or_is_refused(
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


@pytest.mark.slow
@THOROUGH
@pytest.mark.parametrize(
    "name", ["eval", pytest.param("export", marks=SLOW), pytest.param("render", marks=SLOW)]
)
def test_opening_a_damaged_run_gives_the_same_output_or_is_refused(
    finished, tmp_path, capsys, name, thorough
):
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
            assert found[1:] == wanted[1:] or "was edited after" in found[0].err, (file, damage)
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


@pytest.mark.slow
@THOROUGH
def test_comparing_damaged_runs_gives_the_same_tables_or_is_refused(finished, tmp_path, thorough):
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


def moved(finished, scene, folder):
    """Copies of a run and of its scene, which belong together."""
    run = shutil.copytree(finished, folder / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(str(scene), str(folder / "scene")))
    return run, shutil.copytree(scene, folder / "scene")


@THOROUGH
def test_a_damaged_scene_gives_the_same_evaluation_or_is_refused(
    scene, finished, tmp_path, capsys, thorough
):
    run, place = moved(finished, scene, tmp_path)
    wanted = command(capsys, "eval", run)
    assert wanted.code == 0
    files = files_of(scene)
    for file, damage in cases(files if thorough else files[::5], thorough=thorough):
        damaged(scene, place, file, damage)
        found = command(capsys, "eval", run)
        assert found.is_refused or (found.code, found.out) == (0, wanted.out), (file, damage)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A scene with what `prepare` adds to a COLMAP model: masks, and its place on Earth."""
    folder = write_tiny_scene(tmp_path_factory.mktemp("prepared") / "tiny", views=9)
    (folder / "masks").mkdir()
    mask = Image.new("L", (48, 32), 255)
    mask.paste(0, (0, 0, 12, 32))
    for photo in (folder / "images").iterdir():
        mask.save(folder / "masks" / photo.name)
    origin = {"latitude": 52.25, "longitude": 21.0, "altitude": 110.0}
    place = {"origin": origin, "transform": np.diag([2.0, 2.0, 2.0, 1.0]).tolist()}
    (folder / "georef.json").write_text(json.dumps(place))
    return folder


@THOROUGH
def test_a_damaged_prepared_scene_gives_the_same_export_or_is_refused(
    prepared, tmp_path, capsys, thorough
):
    trained = tmp_path / "trained"
    assert ended("run", prepared, "--out", trained, "--steps", 3, "--threads", 1, "-q") == 0
    run, place = moved(trained, prepared, tmp_path)
    wanted = command(capsys, "export", run, "--coordinates", "enu", "--out", tmp_path / "a.ply")
    assert wanted.code == 0
    exported = (tmp_path / "a.ply").read_bytes()
    files = [file for file in files_of(prepared) if "images" not in file.parts]
    for file, damage in cases(files if thorough else files[::2], thorough=thorough):
        damaged(prepared, place, file, damage)
        (tmp_path / "a.ply").unlink(missing_ok=True)
        found = command(capsys, "export", run, "--coordinates", "enu", "--out", tmp_path / "a.ply")
        if found.code == 0:
            assert (tmp_path / "a.ply").read_bytes() == exported, (file, damage)
        else:
            assert found.is_refused and not (tmp_path / "a.ply").exists(), (file, damage, found)


@pytest.mark.slow
@THOROUGH
def test_continuing_a_damaged_sweep_gives_the_same_table_or_is_refused(tmp_path, capsys, thorough):
    scene = write_tiny_scene(tmp_path / "tiny", views=4, width=32, height=24, points=60)
    grid, whole, out = tmp_path / "grid.yaml", tmp_path / "whole", tmp_path / "out"
    grid.write_text(json.dumps({"scenes": [str(scene)], "base": {"steps": 2}}))
    assert ended("sweep", grid, "--out", whole) == 0
    shutil.copytree(whole, out)
    wanted = command(capsys, "sweep", grid, "--out", out)
    assert wanted.code == 0
    files = [file for file in files_of(whole) if thorough or file.parts[0] != "runs"]
    for file, damage in cases(files, thorough=thorough):
        damaged(whole, out, file, damage)
        before = contents(out)
        found = command(capsys, "sweep", grid, "--out", out)
        if found.code == 0:
            same = found.out.replace(str(out), "") == wanted.out.replace(str(out), "")
            assert same, (file, damage, found)
        elif file.parts[0] == "runs":
            # A run that is refused is one that failed, with its reason; others go on.
            assert found.code == 1 and "error: " in found.err, (file, damage, found)
            assert contents(out / "runs") == {
                path.relative_to("runs"): content
                for path, content in before.items()
                if path.parts[0] == "runs"
            }, (file, damage)
        else:
            assert found.is_refused, (file, damage, found)
            assert contents(out) == before, (file, damage)
