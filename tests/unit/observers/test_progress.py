"""Progress: plain lines without a terminal, a bar with one, nothing when quiet."""

import io
import os
from pathlib import Path
from select import select
from types import SimpleNamespace

import pytest

from crossgrad_core.contract.contexts import EvaluationReport, StepRecord
from crossgrad_core.registry.manager import make_manager
from crossgrad_plugins.observers.progress import Progress


class Terminal(io.StringIO):
    """What stderr is when somebody looks at it."""

    def isatty(self) -> bool:
        return True


def run_with(progress: Progress, steps: int = 20, first: int = 1) -> None:
    """A run of `steps` steps with an evaluation and a message in the middle."""
    hook = make_manager({"progress": progress}).hook
    scene = SimpleNamespace(name="boruszyn", train=range(24), test=range(4))
    schedule = SimpleNamespace(total=steps)
    hook.crossgrad_run_start(
        run=SimpleNamespace(
            scene=scene,
            schedule=schedule,
            folder=Path("runs/x"),
            config={"device": "cpu"},
            notes=("no masks",),
            decisions=(),
        )
    )
    for step in range(first, steps + 1):
        counts = {"conflict": 3, "cloned": 1200, "split": 0} if step == 7 else {"conflict": 1}
        record = StepRecord(step, (0,), ("a",), None, (0.25,), 1000, counts, step * 0.1)
        hook.crossgrad_step_end(record=record)
        if step == steps // 2:
            hook.crossgrad_evaluation(
                report=EvaluationReport(step, {"psnr": 21.5, "ssim": 0.7, "train_seconds": 1.0})
            )
            hook.crossgrad_log(text="something to know")
    hook.crossgrad_run_end(status="finished")


def test_plain_lines_are_printed_at_every_tenth_of_the_run(capsys: pytest.CaptureFixture[str]):
    run_with(Progress())
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines[:3] == [
        "boruszyn: 24 training views, 4 held out; 20 steps on cpu",
        "results in runs/x",
        "- more notes: 1 (in log.txt, or with -v)",
    ]
    assert lines[3] == ("step 2/20 (10 %), loss 0.2500, 1,000 primitives, 10.0 steps/s, 2 s left")
    assert len([line for line in lines if line.startswith("step ")]) == 10
    assert "evaluated at step 10: PSNR 21.50 dB, SSIM 0.7000, 1.0 s training" in lines
    assert "something to know" in lines
    assert lines[-1].startswith("step 20/20 (100 %), loss 0.2500, PSNR 21.50")
    assert "\r" not in err


def test_plain_lines_are_printed_after_the_interval(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    times = iter(range(0, 10_000, 4))
    monkeypatch.setattr("crossgrad_plugins.observers.progress.monotonic", lambda: next(times))
    run_with(Progress(interval=8.0), steps=1000, first=995)
    steps = [line.split("/")[0] for line in capsys.readouterr().err.splitlines() if "/1000" in line]
    assert steps == ["step 996", "step 998", "step 1000"]


def test_the_quiet_option_prints_no_progress(capsys: pytest.CaptureFixture[str]):
    run_with(Progress(level="quiet"))
    assert capsys.readouterr() == ("", "")


def test_the_verbose_option_also_prints_density_changes(capsys: pytest.CaptureFixture[str]):
    run_with(Progress(level="verbose"))
    lines = capsys.readouterr().err.splitlines()
    assert "- no masks" in lines
    assert "step 7: 1,200 cloned" in lines
    assert not any("conflict" in line for line in lines)


def test_a_terminal_gets_a_progress_bar(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    run_with(Progress())
    shown = terminal.getvalue()
    last = shown.rstrip("\n").split("\r")[-1]
    assert "20/20" in last
    assert "loss 0.2500, PSNR 21.50, 1,000 primitives" in last
    assert "something to know\n" in shown


def test_the_bar_of_a_resumed_run_does_not_start_at_zero(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    run_with(Progress(), steps=20, first=16)
    assert " 15/20 " in terminal.getvalue()
    assert " 0/20 " not in terminal.getvalue()


def test_a_stopped_run_is_reported_as_stopped(capsys: pytest.CaptureFixture[str]):
    make_manager({"progress": Progress()}).hook.crossgrad_run_end(status="stopped")
    assert capsys.readouterr().err == "run stopped\n"


@pytest.mark.parametrize(
    ("totals", "said"),
    [
        (
            (21, 30, 25, 40, 31, 30),
            ["the number of steps was adapted to the time budget: 30 steps instead of 20"],
        ),
        ((40, 30, 20), []),
        ((21,), []),
    ],
)
def test_changes_of_the_run_length_are_reported_in_one_line_at_the_end(capsys, totals, said):
    hook = make_manager({"progress": Progress()}).hook
    run = SimpleNamespace(
        scene=SimpleNamespace(name="s", train=(), test=()),
        schedule=SimpleNamespace(total=20),
        config={"device": "cpu"},
        folder=None,
        notes=(),
        decisions=(),
    )
    hook.crossgrad_run_start(run=run)
    for step, total in enumerate(totals, 1):
        hook.crossgrad_length_changed(step=step, total=total)
    assert len(capsys.readouterr().err.splitlines()) == 1
    hook.crossgrad_run_end(status="finished")
    assert capsys.readouterr().err.splitlines() == said


def test_a_terminal_without_columns_gets_plain_lines(monkeypatch: pytest.MonkeyPatch):
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()  # Its size is 0 x 0 until somebody sets it.
    with os.fdopen(theirs, "w") as stderr:
        monkeypatch.setattr("sys.stderr", stderr)
        run_with(Progress())
        shown = b""
        while select([ours], [], [], 0.0)[0]:
            shown += os.read(ours, 1 << 16)
    os.close(ours)
    assert b"step 2/20 (10 %)" in shown and b"step 20/20 (100 %)" in shown
