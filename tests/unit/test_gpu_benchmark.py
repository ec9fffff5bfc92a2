"""benchmarks/gpu.py without a GPU: it says so, and its tables come from the folders of runs."""

import csv
import json
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from support.run_folders import ENVIRONMENT, RunFolder
from typer.testing import CliRunner

from crossgrad_core.cli.main import app
from crossgrad_core.commands import configured
from crossgrad_core.errors import UserError

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu.py"
SCENE = SCRIPT.parents[1] / "examples" / "scenes" / "boruszyn"
VERSIONS = {**ENVIRONMENT, "gpu": "H", "commit": "abcdef0", "packages": {"torch": "2.13.0+cu130"}}


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    return SimpleNamespace(**runpy.run_path(str(SCRIPT), run_name="gpu"))


def test_the_benchmark_without_a_gpu_ends_with_code_2(script, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "scene"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 2
    assert "sees no GPU" in capsys.readouterr().err


def test_every_benchmark_case_is_accepted_by_crossgrad(script, tmp_path):
    """All options are known. The only objection is that the machine has no GPU."""
    cases = list(script.cases(10, 60))
    assert len(cases) == len({case.name for case in cases})
    for part in ("long", "usual"):
        first = next(case for case in cases if case.part == part)
        answer = CliRunner().invoke(app, first.command(tmp_path, tmp_path / "out")[3:])
        assert isinstance(answer.exception, UserError), answer.output
        assert answer.exception.where == "--device"
    for case in cases:
        configured(case.config(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("gaussians", [0, 500])
def test_short_cases_run_in_the_process_of_the_benchmark(script, tmp_path, monkeypatch, gaussians):
    """The cases run on the CPU without the GPU queries."""
    cloud = import_module("scale").Run
    begun, config, on_cpu = cloud.__init__, script.Case.config, {"device": "cpu"}
    monkeypatch.setattr(cloud, "__init__", lambda run, cell, **o: begun(run, cell, **o | on_cpu))
    monkeypatch.setattr(script.Case, "config", lambda *given: config(*given) | on_cpu)
    for name in ("empty_cache", "reset_peak_memory_stats", "synchronize"):
        monkeypatch.setattr(torch.cuda, name, lambda *_: None)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda: 2**20)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: 4 * 2**20)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "H")
    short = script.Short(SCENE, tmp_path / "short.jsonl", "here")
    good = script.Case("steps", "numba", "vanilla", 2, "pcgrad", 3, gaussians)
    refused = script.Case("steps", "numba", "vanilla", 1, "nobody", 3, gaussians)
    row = short.row(good)
    assert row["views_per_second"] == pytest.approx(2e3 / row["ms_per_step"], rel=0.02)
    assert row["peak_mib"] == 3.0
    assert gaussians in {0, row["primitives"]}
    why = short.row(refused)
    assert "nobody" in why["note"]
    assert why["primitives"] == (gaussians or "")
    with (tmp_path / "short.jsonl").open("a") as file:
        file.write('{"case": "cut o')
    again = script.Short(SCENE, tmp_path / "short.jsonl", "here")
    assert again.row(good) == again.known(good) == row
    # Another place has other figures, and what was missing may be there now.
    assert again.known(refused) is None
    assert script.Short(SCENE, tmp_path / "short.jsonl", "there").known(good) is None


def test_a_failed_case_is_recorded_and_tried_again(script, tmp_path, monkeypatch):
    def fails(_short, _case):
        raise RuntimeError("out of\nmemory")

    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(script.Short, "_measured", fails)
    short = script.Short(tmp_path, tmp_path / "short.jsonl", "here")
    case = script.Case("steps", "gsplat", "vanilla", 1, "sum", 3)
    assert short.row(case)["note"] == "RuntimeError: out of memory"
    assert not (tmp_path / "short.jsonl").exists()
    # After an illegal access nothing on the GPU can be believed.
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: fails(short, case))
    with pytest.raises(RuntimeError, match="out of"):
        short.row(case)


def test_a_filter_that_matches_no_case_ends_with_code_2(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu.py", "scene", "--only", "sizes", "tall"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 2
    assert "no case has 'tall' in its name: sizes-gsplat" in capsys.readouterr().err


def test_earlier_measurements_are_kept_in_the_table(script, tmp_path, monkeypatch):
    case = next(iter(script.cases(10, 60)))
    monkeypatch.setattr(script.Short, "_measured", lambda *_: {"ms_per_step": 1.5})
    short = script.Short(tmp_path, tmp_path / "short.jsonl", "here")
    assert script.case_rows(case, short, tmp_path, new=False) == ([], [])
    assert script.case_rows(case, short, tmp_path, new=True)[0][0]["ms_per_step"] == 1.5
    again = script.Short(tmp_path, tmp_path / "short.jsonl", "here")
    assert len(script.case_rows(case, again, tmp_path, new=False)[0]) == 1


def test_long_runs_are_trained_once_and_refusals_are_recorded(script, tmp_path, monkeypatch):
    asked, run = [], subprocess.run

    def crossgrad(command, **options):
        if command[0] == "git":
            return run(command, **options)
        asked.append(command)
        out = Path(command[command.index("--out") + 1])
        views = command[command.index("--views") + 1]
        if "gswarp" in command:
            why = "gswarp does\nnot | draw it", "out of memory"
            return SimpleNamespace(returncode=int(views), stderr=why[views == "1"])
        RunFolder(steps=10, seconds=2.0, environment=VERSIONS).write(out)
        return SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(subprocess, "run", crossgrad)
    arguments = SimpleNamespace(
        out=tmp_path / "gpu",
        scene=tmp_path,
        steps=10,
        long=10,
        gsplat_examples=None,
        only=["long"],
    )
    script.run_all(arguments, "H")
    cases = [case for case in script.cases(10, 10) if case.part == "long"]
    assert len(asked) == len(cases) == 4
    with (tmp_path / "gpu" / "gpu.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, case in zip(rows, cases, strict=True):
        if case.rasterizer == "gswarp":
            expected = {1: "out of memory", 2: "gswarp does not | draw it"}
            assert row["note"] == expected[case.views]
        else:
            assert float(row["ms_per_step"]) == 200.0
            assert row["code"] == "abcdef0"
    table = (tmp_path / "gpu" / "gpu.md").read_text()
    assert table.count("\n| ") == len(cases) + 1
    assert len((tmp_path / "gpu" / "gpu_curves.csv").read_text().splitlines()) > 4
    asked.clear()
    script.run_all(arguments, "H")
    assert [command[command.index("--views") + 1] for command in asked] == ["1"]


def test_results_of_the_gsplat_trainer_are_read_from_its_files(script, tmp_path):
    """Read results of every stop that was reached. A finished training is not repeated."""
    stats = tmp_path / "runs" / "gsplat-trainer-8000" / "stats"
    stats.mkdir(parents=True)
    for stop, seconds in ((7000, 7.0), (8000, 9.6)):
        training = {"mem": 1.5, "ellipse_time": seconds, "num_GS": 123}
        (stats / f"train_step{stop - 1}_rank0.json").write_text(json.dumps(training))
        shown = {"psnr": 21.25, "num_GS": 123}
        (stats / f"val_step{stop - 1}.json").write_text(json.dumps(shown))
    early, late = script.theirs(tmp_path, tmp_path, tmp_path, 8000)
    assert (early["steps"], early["ms_per_step"]) == (7000, 1.0)
    assert (late["steps"], late["ms_per_step"]) == (8000, 1.2)
    assert (late["psnr"], late["primitives"], late["peak_mib"]) == (21.25, 123, 1536.0)


def test_steps_that_the_gsplat_trainer_did_not_reach_have_no_results(script, tmp_path, monkeypatch):
    ended = SimpleNamespace(returncode=1, stderr="no\nmemory")
    asked = []
    monkeypatch.setattr(subprocess, "run", lambda command, **_: asked.append(command) or ended)
    (row,) = script.theirs(tmp_path, tmp_path, tmp_path, 16_000)
    assert (row["steps"], row["note"], row["psnr"]) == (16_000, "no memory", "")
    assert asked[0].count("15000") == 2
    monkeypatch.undo()
    (tmp_path / "simple_trainer.py").write_text("import time; time.sleep(60)")
    (row,) = script.theirs(tmp_path, tmp_path, tmp_path, 16_000, 0.5)
    assert row["note"] == "stopped after 0.5 s"
