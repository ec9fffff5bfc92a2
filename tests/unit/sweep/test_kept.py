"""What is left of a sweep that is kept, as benchmarks/kept.py packs it."""

import json
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.run_folders import RunFolder

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.sweep.run_status import is_finished

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "kept.py"


@pytest.fixture(scope="module")
def script():
    return SimpleNamespace(**runpy.run_path(str(SCRIPT)))


@pytest.fixture
def sweep(tmp_path):
    for seed in range(3):
        RunFolder(seed=seed).write(tmp_path / "sweep" / "runs" / f"r{seed}")
    (tmp_path / "sweep" / "runs" / "r0" / "point_cloud.ply").write_bytes(b"ply" * 1000)
    for suffix in ("csv", "json"):
        (tmp_path / "sweep" / "runs" / "r1" / f"per_view_on_city.{suffix}").write_text("there")
    (tmp_path / "sweep" / "runs.csv").write_text("run,configuration\nr0,a\nr1,a\nr2,a\n")
    return tmp_path / "sweep"


def contents(folder):
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_packing_keeps_tables_and_removes_models(script, sweep, tmp_path):
    archive = tmp_path / "results" / "grid.tar.xz"
    assert script.pack(sweep, archive) == 3
    assert script.unpack(archive, tmp_path / "back") == 3
    (sweep / "runs" / "r0" / "point_cloud.ply").unlink()
    assert (tmp_path / "back" / "runs" / "r1" / "per_view_on_city.json").is_file()
    assert contents(tmp_path / "back") == contents(sweep)
    assert all(is_finished(each) for each in (tmp_path / "back" / "runs").iterdir())
    found = read_runs([tmp_path / "back"], skip_broken=False)
    assert len(found.runs) == 3 and not found.left_out
    again = tmp_path / "again.tar.xz"
    script.pack(tmp_path / "back", again)
    assert again.read_bytes() == archive.read_bytes()


def test_unfinished_runs_are_not_packed(script, sweep, tmp_path):
    path = sweep / "runs" / "r1" / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "status": "interrupted"}))
    (sweep / "runs" / "r2" / "summary.json").unlink()
    assert script.pack(sweep, tmp_path / "grid.tar.xz") == 1
    (sweep / "runs" / "r0" / "summary.json").unlink()
    with pytest.raises(UserError, match="nothing to keep"):
        script.pack(sweep, tmp_path / "grid.tar.xz")


def test_runs_without_a_sweep_are_refused_and_no_archive_is_written(script, sweep, tmp_path):
    (sweep / "runs.csv").unlink()
    with pytest.raises(UserError, match="nothing to keep"):
        script.pack(sweep, tmp_path / "results" / "grid.tar.xz")
    assert not (tmp_path / "results").exists()


def test_unpacking_keeps_existing_runs(script, sweep, tmp_path):
    script.pack(sweep, tmp_path / "grid.tar.xz")
    (sweep / "runs" / "r0" / "metrics.csv").write_text("newer")
    (sweep / "runs.csv").write_text("run,configuration\nr2,a\nr1,a\nr0,a\n")
    (sweep / "runs" / "r2").rename(tmp_path / "gone")
    before = contents(sweep)
    assert script.unpack(tmp_path / "grid.tar.xz", sweep) == 1
    after = contents(sweep)
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[1] for name in set(after) - set(before)} == {"r2"}


def labels(sweep):
    return {
        run.name.rpartition("/")[2]: run.label for run in read_runs([sweep], skip_broken=False).runs
    }


def test_added_runs_keep_their_labels(script, sweep, tmp_path):
    script.pack(sweep, tmp_path / "grid.tar.xz")
    other = tmp_path / "other"
    RunFolder(seed=7).write(other / "runs" / "r7")
    RunFolder(seed=0).write(other / "runs" / "r0")
    (other / "runs.csv").write_text("run,configuration\nr7,b\nr0,b\n")
    assert script.unpack(tmp_path / "grid.tar.xz", other) == 2
    lines = ["run,configuration", "r7,b", "r0,b", "r0,a", "r1,a", "r2,a"]
    assert (other / "runs.csv").read_text().splitlines() == lines
    assert {run: label for run, label in labels(other).items() if run != "r0"} == {
        "r1": "a", "r2": "a", "r7": "b",
    }  # fmt: skip
    script.pack(other, tmp_path / "both.tar.xz")
    script.unpack(tmp_path / "both.tar.xz", tmp_path / "back")
    assert labels(tmp_path / "back") == labels(other)


def test_lost_labels_are_restored_from_the_archive(script, sweep, tmp_path):
    script.pack(sweep, tmp_path / "grid.tar.xz")
    (sweep / "runs.csv").write_text("run,configuration\nr0,a\n")
    with pytest.raises(UserError, match="not in the table") as error:
        script.pack(sweep, tmp_path / "again.tar.xz")
    assert "r1, r2" in error.value.found
    assert script.unpack(tmp_path / "grid.tar.xz", sweep) == 0
    assert set(labels(sweep).values()) == {"a"}
    script.pack(sweep, tmp_path / "again.tar.xz")
    assert (tmp_path / "again.tar.xz").read_bytes() == (tmp_path / "grid.tar.xz").read_bytes()


def test_tables_of_another_format_are_refused_before_anything_is_written(script, sweep, tmp_path):
    script.pack(sweep, tmp_path / "grid.tar.xz")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "runs.csv").write_text("run,name\n")
    with pytest.raises(UserError, match="different columns"):
        script.unpack(tmp_path / "grid.tar.xz", tmp_path / "other")
    assert list(contents(tmp_path / "other")) == ["runs.csv"]
