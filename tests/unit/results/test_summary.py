"""summary.json, per_view.csv and the final table."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.machine import environment
from crossgrad_core.run.results.metrics_csv import metrics_row, write_per_view
from crossgrad_core.run.results.summary import Summary, final_table, read_summary, write_summary
from crossgrad_core.training.state import Clock


@pytest.fixture(name="summary")
def _summary(result, totals) -> Summary:
    rows = [metrics_row(totals, result)]
    rows.insert(0, {**rows[0], "step": 350, "psnr": 25.0})
    rows.insert(0, {**rows[0], "step": 10, "psnr": None})
    rows.insert(0, {**rows[0], "step": 5, "psnr": float("nan")})
    return Summary(
        status="finished",
        scene="boruszyn",
        totals=totals,
        result=result,
        rows=rows,
        seconds=Clock(train=38.2, compile=9.1, load=1.5, evaluate=3.0, report=0.8),
        config={"seed": 7, "scene": Path("scenes/boruszyn"), "lr": float("nan")},
        environment={"crossgrad": "0.1.0"},
        notes=("no grouping: one distance",),
    )


def test_the_summary_contains_status_metrics_and_configuration(tmp_path: Path, summary: Summary):
    write_summary(tmp_path, summary)
    found = read_summary(tmp_path)
    assert found["status"] == "finished"
    assert found["overall"] == {
        "views": 3,
        "psnr": pytest.approx(24.0),
        "ssim": pytest.approx(0.7),
        "ssim_skimage": pytest.approx(2.35 / 3),
        "lpips": None,
    }
    assert found["regimes"]["near"] == {
        "views": 2,
        "psnr": 21.0,
        "ssim": 0.6,
        "ssim_skimage": pytest.approx(0.7),
        "lpips": None,
    }
    assert "LPIPS needs" in found["null"]["lpips"]
    assert found["best"] == {
        "step": 350,
        "train_seconds": 38.21,
        "psnr": 25.0,
        "ssim": 0.7000000000000001,
    }
    assert found["seconds"]["compile"] == 9.1
    assert found["seed"] == 7
    assert found["notes"] == ["no grouping: one distance"]
    assert found["primitives"] == 111_785
    assert found["backward_passes"] == 1400
    assert "11 x 11" in found["definitions"]["ssim"]
    assert found["falling"] == ["lpips"]
    assert found["config"]["scene"] == "scenes/boruszyn"


def test_the_summary_is_strict_json(tmp_path: Path, summary: Summary):
    write_summary(tmp_path, replace(summary, totals=replace(summary.totals, loss=float("inf"))))

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    found = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert found["config"]["lr"] is None
    assert found["loss"] is None


def test_a_run_without_held_out_views_records_the_reason(tmp_path: Path, summary: Summary, empty):
    write_summary(tmp_path, replace(summary, result=empty, rows=[]))
    found = read_summary(tmp_path)
    assert found["overall"]["psnr"] is None
    assert found["overall"]["views"] == 0
    assert "no held-out views" in found["null"]["psnr"]
    assert found["best"] is None


def test_a_failed_run_records_the_error(tmp_path: Path, summary: Summary):
    write_summary(
        tmp_path, replace(summary, status="failed", error="means is not finite", result=None)
    )
    found = read_summary(tmp_path)
    assert (found["status"], found["error"]) == ("failed", "means is not finite")
    assert found["overall"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "does not contain summary.json"), ("{", "summary.json cannot be read")],
)
def test_missing_and_damaged_summaries_are_reported(tmp_path: Path, text: str | None, message: str):
    if text is not None:
        (tmp_path / "summary.json").write_text(text)
    with pytest.raises(UserError, match=message):
        read_summary(tmp_path)


def test_the_environment_contains_machine_and_versions():
    found = environment()
    # Some builds name theirs only in torch itself: 2.3.0+cu121.
    assert torch.__version__.startswith(found["packages"]["torch"])
    assert found["packages"]["numpy"] == np.__version__
    assert found["packages"]["numba"] == numba.__version__
    assert found["cpu"]
    assert found["gpu"] is None
    json.dumps(found)


def test_the_per_view_table_contains_every_view(tmp_path: Path, result):
    write_per_view(tmp_path, result)
    with (tmp_path / "per_view.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["near/1.jpg", "near/2.jpg", "far/1.jpg"]
    assert rows[2] == {
        "name": "far/1.jpg",
        "regime": "far",
        "psnr": "30.0",
        "ssim": "0.9",
        "ssim_skimage": "0.95",
        "lpips": "",
    }


def test_the_final_table_shows_metrics_overall_and_per_regime(result, totals):
    assert final_table(result, totals).splitlines() == [
        "         views   PSNR    SSIM  SSIM (skimage)",
        "overall      3  24.00  0.7000          0.7833",
        "far          1  30.00  0.9000          0.9500",
        "near         2  21.00  0.6000          0.7000",
        "38.2 s training, 700 steps, 1,400 views rendered, 1,400 backward passes, "
        "111,785 primitives, peak memory 1,523 MiB",
    ]


def test_the_final_table_shows_a_single_regime_once_and_measured_lpips(result, totals):
    one = replace(
        result,
        regimes={"far": result.regimes["far"]},
        overall=replace(result.overall, values={**result.overall.values, "lpips": 0.12345}),
        reasons={},
    )
    lines = final_table(one, totals).splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["views", "overall"]
    assert lines[0].endswith("LPIPS")
    assert lines[1].endswith("0.1235")
    assert len(lines) == 3


def test_the_final_table_of_a_run_without_held_out_views_shows_costs_only(empty, totals):
    text = final_table(empty, totals)
    assert "no psnr: no held-out views" in text
    assert "38.2 s training" in text
    assert final_table(None, totals).startswith("38.2 s training")


@pytest.mark.parametrize("content", [b"[" * 100_000, b"[1]", b"null", b"\xff", b"", b"9" * 9999])
def test_an_unreadable_summary_is_reported(tmp_path: Path, content: bytes):
    (tmp_path / "summary.json").write_bytes(content)
    with pytest.raises(UserError, match=r"summary\.json cannot be read(?s:.*)to do"):
        read_summary(tmp_path)
