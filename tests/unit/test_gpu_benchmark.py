"""benchmarks/gpu.py without a GPU: it says so, and its tables come from the folders of runs."""

import csv
import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from support.run_folders import ENVIRONMENT, RunFolder
from typer.testing import CliRunner

from crossgrad_core.cli.main import app
from crossgrad_core.errors import UserError

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu.py"
VERSIONS = {**ENVIRONMENT, "gpu": "H", "commit": "abcdef0", "packages": {"torch": "2.13.0+cu130"}}


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    return SimpleNamespace(**runpy.run_path(str(SCRIPT), run_name="gpu"))


def test_without_a_gpu_it_says_so_and_ends_with_2(script, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "scene"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 2
    assert "sees no GPU" in capsys.readouterr().err


def test_every_command_is_one_that_crossgrad_takes(script, tmp_path):
    """All options are known; a machine without a GPU is the only thing to object to."""
    for case in {case.part: case for case in script.cases(10, 60)}.values():
        words = case.command(tmp_path, tmp_path / "out")
        answer = CliRunner().invoke(app, words[3:])
        assert isinstance(answer.exception, UserError), answer.output
        assert answer.exception.where == "--device"


def test_runs_are_trained_once_and_refusals_are_kept(script, tmp_path, monkeypatch):
    asked, run = [], subprocess.run

    def crossgrad(command, **options):
        if command[0] == "git":
            return run(command, **options)
        asked.append(command)
        out = Path(command[command.index("--out") + 1])
        if "mip" in command:
            return SimpleNamespace(returncode=2, stderr="gswarp does\nnot | draw it")
        if "octree" in command:
            return SimpleNamespace(returncode=1, stderr="out of memory")
        RunFolder(steps=10, seconds=2.0, environment=VERSIONS).write(out)
        return SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(subprocess, "run", crossgrad)
    arguments = SimpleNamespace(
        out=tmp_path / "gpu", scene=tmp_path, steps=10, long=10, gsplat_examples=None
    )
    script.run_all(arguments, "H")
    cases = list(script.cases(10, 10))
    assert len(asked) == len(cases) == len(set(cases))
    with (tmp_path / "gpu" / "gpu.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, case in zip(rows, cases, strict=True):
        if case.backbone == "mip":
            assert row["note"] == "gswarp does not | draw it"
        elif case.backbone == "octree":
            assert row["note"] == "out of memory"
        else:
            assert float(row["ms_per_step"]) == 200.0
            assert row["code"] == "abcdef0"
    table = (tmp_path / "gpu" / "gpu.md").read_text()
    assert table.count("\n| ") == len(cases) + 1
    assert len((tmp_path / "gpu" / "gpu_curves.csv").read_text().splitlines()) > 12
    asked.clear()
    script.run_all(arguments, "H")
    assert all("octree" in command for command in asked)
    assert len(asked) == sum(case.backbone == "octree" for case in cases)


def test_the_trainer_of_gsplat_is_read_from_its_files(script, tmp_path):
    stats = tmp_path / "runs" / "gsplat-trainer-7" / "stats"
    stats.mkdir(parents=True)
    training = {"mem": 1.5, "ellipse_time": 0.7, "num_GS": 123}
    (stats / "train_step6_rank0.json").write_text(json.dumps(training))
    (stats / "val_step6.json").write_text(json.dumps({"psnr": 21.25, "num_GS": 123}))
    row = script.theirs(tmp_path, tmp_path, tmp_path, 7)
    assert (row["ms_per_step"], row["psnr"], row["primitives"]) == (100.0, 21.25, 123)
    assert row["peak_mib"] == 1536.0
