"""Lines about a run under way, and log.txt."""

from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from crossgrad_core.contract.contexts import EvaluationReport, StepRecord
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.results.log import Pace, RunLog, duration, evaluation_line, progress_line


def record(step: int, losses: tuple[float, ...] = (0.1, 0.3), seconds: float = 0.5) -> StepRecord:
    names = ("a.jpg",) * len(losses)
    return StepRecord(step, (0,) * len(losses), names, None, losses, 1234, {}, step * seconds)


def test_the_progress_line_shows_loss_steps_per_second_and_remaining_time():
    pace = Pace(total=1000)
    assert progress_line(pace) == ""
    for step in (1, 2, 3):
        pace = pace.after(record(step))
    assert progress_line(pace) == (
        "step 3/1000 (0 %), loss 0.2000, 1,234 primitives, 2.0 steps/s, 8:18 left"
    )


def test_the_progress_line_shows_a_smoothed_loss():
    pace = Pace(total=10).after(record(1, (1.0,)))
    assert pace.loss == 1.0
    assert pace.after(record(2, (0.0,))).loss == pytest.approx(0.95)


def test_progress_of_a_resumed_run_begins_at_its_step():
    pace = Pace(total=1000).after(record(701))
    assert pace.first == 700
    assert pace.steps_per_second is None
    assert "step 701/1000 (70 %)" in progress_line(pace)


def test_progress_is_measured_against_the_newest_length():
    pace = Pace(total=1000).after(record(300)).with_length(600)
    assert "step 300/600 (50 %)" in progress_line(pace)


def test_the_last_evaluation_is_shown_in_later_lines():
    pace = Pace(total=10).after(record(1))
    assert pace.evaluated(EvaluationReport(1, {"psnr": None})).psnr is None
    assert "PSNR 21.50" in progress_line(pace.evaluated(EvaluationReport(1, {"psnr": 21.5})))


@pytest.mark.parametrize(
    ("row", "regimes", "expected"),
    [
        (
            {"psnr": 21.5, "ssim": 0.7, "psnr_far": 20.0, "psnr_near": 23.0, "train_seconds": 3.0},
            ("far", "near"),
            "PSNR 21.50 dB, SSIM 0.7000, PSNR far 20.00, PSNR near 23.00, 3.0 s training",
        ),
        (
            {"psnr": 21.5, "ssim": 0.7, "psnr_far": 21.5, "train_seconds": 3.0},
            ("far",),
            "PSNR 21.50 dB, SSIM 0.7000, 3.0 s training",
        ),
        (
            {"psnr": 21.5, "ssim": 0.7, "psnr_cc": 22.0, "psnr_x": 1.0, "train_seconds": 3.0},
            (),
            "PSNR 21.50 dB, SSIM 0.7000, 3.0 s training",
        ),
        ({"psnr": None, "ssim": None, "train_seconds": 3}, (), "no PSNR, no SSIM, 3.0 s training"),
    ],
)
def test_the_evaluation_line_shows_metrics_overall_and_per_regime(
    row: dict[str, float | None], regimes: tuple[str, ...], expected: str
):
    assert evaluation_line(EvaluationReport(7, row, regimes)) == f"evaluated at step 7: {expected}"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1:00"), (11_229, "3:07:09")]
)
def test_durations_are_formatted_readably(seconds: float, text: str):
    assert duration(seconds) == text


def test_the_log_contains_all_messages_of_a_run(tmp_path: Path):
    log = RunLog(tmp_path, clock=lambda: datetime(2026, 3, 5, 9, 8, 7).astimezone())
    hook = make_manager({"log": log}).hook
    run = SimpleNamespace(
        schedule=SimpleNamespace(total=40),
        scene=SimpleNamespace(name="boruszyn"),
        notes=("no masks",),
        decisions=(),
    )
    hook.crossgrad_run_start(run=run)
    for step in range(1, 5):
        hook.crossgrad_step_end(record=record(step))
    hook.crossgrad_log(text="first\n\nthird")
    hook.crossgrad_evaluation(report=EvaluationReport(4, {"psnr": 20.0, "ssim": 0.5}))
    hook.crossgrad_length_changed(step=4, total=50)
    hook.crossgrad_length_changed(step=5, total=60)
    hook.crossgrad_run_end(status="stopped")
    lines = (tmp_path / "log.txt").read_text().splitlines()
    assert all(line.startswith("09:08:07") for line in lines)
    assert [line[8:].strip() for line in lines] == [
        "2026-03-05, scene boruszyn, 40 steps",
        "no masks",
        "step 2/40 (5 %), loss 0.2000, 1,234 primitives, 2.0 steps/s, 19 s left",
        "step 4/40 (10 %), loss 0.2000, 1,234 primitives, 2.0 steps/s, 18 s left",
        "first",
        "",
        "third",
        "evaluated at step 4: PSNR 20.00 dB, SSIM 0.5000, - s training",
        "the number of steps was adapted to the time budget: 60 steps instead of 40",
        "run stopped",
    ]


def test_a_resumed_run_continues_its_log(tmp_path: Path):
    RunLog(tmp_path).write("first session")
    RunLog(tmp_path).write("second session")
    lines = (tmp_path / "log.txt").read_text().splitlines()
    assert [line[10:] for line in lines] == ["first session", "second session"]


def test_a_log_that_cannot_be_written_marks_the_gap_and_ends_no_run(tmp_path: Path, monkeypatch):
    log = RunLog(tmp_path)
    log.write("first")

    def full(self, *args, **kwargs):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(Path, "open", full)
        log.write("lost")
    log.write("third")
    lines = (tmp_path / "log.txt").read_text().splitlines()
    assert [line[10:] for line in lines] == [
        "first", "(lines are missing here: No space left on device)", "third",
    ]  # fmt: skip


def test_any_text_can_be_logged(tmp_path: Path):
    RunLog(tmp_path).write("a photo named \udcff.jpg")
    assert (tmp_path / "log.txt").read_text().rstrip().endswith("a photo named \\udcff.jpg")
