"""Results are read back without torch, many runs in little time."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.figures import columns

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run.results.config_file import write_config
from crossgrad_core.run.results.metrics_csv import MetricsCsv, metrics_row, write_per_view
from crossgrad_core.run.results.reading import find_runs, read_run
from crossgrad_core.run.results.summary import Summary, write_summary
from crossgrad_core.training.state import PHASES, Clock, PhaseTimer

RUNS = 60
PROGRAM = """
import sys
from pathlib import Path
from crossgrad_core.run.results.metrics_csv import write_per_view
from crossgrad_core.run.results.reading import find_runs, read_run
runs = [read_run(folder) for folder in find_runs(Path(sys.argv[1]))]
assert all(run.regimes == ("far", "near") for run in runs)
print(len(runs))
print(" ".join(sys.modules))
"""


@pytest.fixture(name="folder")
def _folder(tmp_path: Path, result, totals) -> Path:
    """The folder of a run with 30 evaluations."""
    folder = tmp_path / "runs" / "first"
    folder.mkdir(parents=True)
    config = RunConfig(scene=Path("scene"), steps=700)
    write_config(folder, config)
    table = MetricsCsv.create(folder, columns(["far", "near"]))
    rows = [metrics_row(replace(totals, step=step), result) for step in range(10, 310, 10)]
    for row in rows:
        table.append(row)
    data = config.model_dump(mode="json")
    summary = Summary("finished", "scene", totals, result, rows, Clock(train=3.0), data, {})
    write_summary(folder, summary)
    write_per_view(folder, result)
    return folder


def test_sixty_runs_are_read_without_importing_torch(folder: Path):
    for number in range(1, RUNS):
        shutil.copytree(folder, folder.with_name(f"run-{number:02}"))
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, folder.parent], capture_output=True, text=True, check=True
    )
    count, modules = ended.stdout.splitlines()
    assert int(count) == RUNS
    assert {"torch", "numba", "scipy"}.isdisjoint(modules.split())


def test_metrics_of_a_run_are_read_by_name_and_regime(folder: Path, result):
    run = read_run(folder)
    assert run.config["steps"] == 700
    assert run.figure("psnr") == result.overall["psnr"]
    assert run.figure("psnr", "near") == 21.0
    assert run.figure("lpips") is None
    assert run.figure("psnr", "nowhere") is None
    assert run.curve("ssim", "far") == [(38.21, 0.9)] * 30
    assert run.curve("psnr", "near", over="step") == [(step, 21.0) for step in range(10, 310, 10)]
    assert run.views == result.views


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "an empty file"),
        ("name,psnr\n", "name,psnr"),
        ("name,regime,psnr,psnr\n", "name,regime,psnr,psnr"),
        ("name,regime,psnr\na,b\n", "2: a,b"),
        ("name,regime,psnr\na,b,high\n", "not a number"),
    ],
)
def test_a_damaged_per_view_table_is_named(folder: Path, content: str, found: str):
    (folder / "per_view.csv").write_text(content)
    with pytest.raises(UserError, match=r"per_view.csv cannot be read") as error:
        read_run(folder)
    assert found in error.value.found
    assert str(folder) in error.value.where


def test_regimes_are_read_from_the_summary_and_not_from_column_names(folder: Path):
    summary = json.loads((folder / "summary.json").read_text())
    summary["overall"]["psnr_cc"] = 1.0
    (folder / "summary.json").write_text(json.dumps(summary))
    assert read_run(folder).regimes == ("far", "near")


def test_an_unfinished_run_has_rows_and_no_final_metrics(folder: Path):
    (folder / "summary.json").unlink()
    run = read_run(folder)
    assert (run.summary, run.regimes, run.figure("psnr")) == (None, (), None)
    assert len(run.rows) == 30


def test_runs_are_found_at_any_depth(folder: Path):
    assert find_runs(folder.parents[1]) == (folder,)
    assert find_runs(folder) == (folder,)


def test_another_folder_is_refused_as_a_run(tmp_path: Path):
    with pytest.raises(UserError, match="not the folder of a run"):
        read_run(tmp_path)


def test_phases_of_a_step_add_up_without_the_excluded_time():
    clock, laps = Clock(), PhaseTimer()
    laps.lap("decode")
    laps.lap("render")
    laps.lap("decode")
    laps.leave_out(5.0, 0.0)
    laps.lap("loss")
    clock.count(laps)
    assert list(clock.phases) == list(PHASES)
    assert clock.train == pytest.approx(sum(clock.phases.values()), abs=1e-12)
    # The five seconds were left out, although here they never passed.
    assert clock.phases["loss"] < -4.0
    kept = clock.copy()
    clock.count(laps)
    assert kept.phases != clock.phases
