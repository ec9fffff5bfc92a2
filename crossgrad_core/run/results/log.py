"""log.txt, which contains the messages of a run with the time of day."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import EvaluationReport, RunInfo, StepRecord
from crossgrad_core.recipe.table import full_lines
from crossgrad_core.system.check_writable import check_own
from crossgrad_core.wording import showable

#: Weight of a new value in the smoothed loss and in the smoothed time per step.
SMOOTHING = 0.05
#: Smallest change of the number of steps that is reported, as a share of the planned number.
NEWS_SHARE = 0.1


@dataclass(frozen=True)
class Pace:
    """Smoothed statistics of the steps so far.

    Attributes:
        total: Number of steps of the whole run.
        first: The step after which this session began (above 0 for a resumed run).
        record: The last step; None before the first step.
        loss: Exponentially smoothed mean loss of the step's views.
        seconds: Exponentially smoothed training seconds of a step; None before the second step.
        psnr: Overall PSNR of the last evaluation; None before the first evaluation.
        planned: Number of steps of the first plan if the length has changed; None otherwise.
    """

    total: int
    first: int = 0
    record: StepRecord | None = None
    loss: float = 0.0
    seconds: float | None = None
    psnr: float | None = None
    planned: int | None = None

    def after(self, record: StepRecord) -> "Pace":
        """Return the statistics after one more step."""
        loss = sum(record.losses) / len(record.losses)
        if self.record is None:
            return replace(self, first=record.step - 1, record=record, loss=loss)
        return replace(
            self,
            record=record,
            loss=_smoothed(self.loss, loss),
            seconds=_smoothed(self.seconds, record.train_seconds - self.record.train_seconds),
        )

    def with_length(self, total: int) -> "Pace":
        """Return the statistics of a run that now has `total` steps."""
        planned = self.total if self.planned is None else self.planned
        return replace(self, total=total, planned=planned)

    def evaluated(self, report: EvaluationReport) -> "Pace":
        """Return the statistics after an evaluation."""
        psnr = report.row.get("psnr")
        return replace(self, psnr=float(psnr)) if isinstance(psnr, int | float) else self

    @property
    def steps_per_second(self) -> float | None:
        """Steps per training second; None while unknown."""
        return 1.0 / self.seconds if self.seconds else None

    @property
    def seconds_left(self) -> float | None:
        """Training seconds until the end at the present speed; None while unknown."""
        if self.record is None or not self.seconds:
            return None
        return (self.total - self.record.step) * self.seconds


def progress_line(pace: Pace) -> str:
    """Return a line about the progress of a run; empty before the first step."""
    record = pace.record
    if record is None:
        return ""
    share = 100.0 * record.step / pace.total
    parts = [f"step {record.step}/{pace.total} ({share:.0f} %)", *figures(pace)]
    if pace.steps_per_second is not None and pace.seconds_left is not None:
        parts.append(f"{pace.steps_per_second:.1f} steps/s")
        parts.append(f"{duration(pace.seconds_left)} left")
    return ", ".join(parts)


def length_lines(pace: Pace) -> list[str]:
    """Return a line about a changed number of steps if the change is at least `NEWS_SHARE`."""
    planned = pace.planned
    if planned is None or abs(pace.total - planned) < NEWS_SHARE * planned:
        return []
    return [
        (
            f"the number of steps was adapted to the time budget: {pace.total} steps "
            f"instead of {planned}"
        )
    ]


def figures(pace: Pace) -> list[str]:
    """Return the texts of loss, PSNR and number of primitives, for log and progress bar."""
    parts = [f"loss {pace.loss:.4f}"]
    if pace.psnr is not None:
        parts.append(f"PSNR {pace.psnr:.2f}")
    if pace.record is not None:
        parts.append(f"{pace.record.primitives:,} primitives")
    return parts


def evaluation_line(report: EvaluationReport) -> str:
    """Return the metrics of an evaluation, overall and of each regime."""
    row = report.row
    parts = [_metric("PSNR", row.get("psnr"), ".2f", " dB"), _metric("SSIM", row.get("ssim"))]
    if len(report.regimes) > 1:
        parts += [f"PSNR {_regime(row, regime)}" for regime in report.regimes]
    parts.append(f"{_number(row.get('train_seconds'), '.1f')} s training")
    return f"evaluated at step {report.step}: " + ", ".join(parts)


def duration(seconds: float) -> str:
    """Format seconds as 45 s, 12:05 or 3:07:09."""
    whole = round(seconds)
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02}:{rest:02}"
    return f"{minutes}:{rest:02}" if minutes else f"{rest} s"


def roughly(seconds: float) -> str:
    """Format an estimated time in whole minutes, or in hours and minutes from two hours on."""
    minutes = max(1, round(seconds / 60.0))
    if minutes < 120:  # noqa: PLR2004 - two hours
        return f"about {minutes} min"
    return f"about {minutes // 60} h {minutes % 60:02} min"


def _smoothed(old: float | None, new: float) -> float:
    return new if old is None else old + SMOOTHING * (new - old)


def _regime(row: Mapping[str, float | int | str | None], regime: str) -> str:
    return f"{regime} {_number(row.get(f'psnr_{regime}'), '.2f')}"


def _metric(label: str, value: float | str | None, form: str = ".4f", unit: str = "") -> str:
    return f"{label} {_number(value, form)}{unit}" if value is not None else f"no {label}"


def _number(value: float | str | None, form: str) -> str:
    return format(value, form) if isinstance(value, int | float) else "-"


FILE = "log.txt"
#: Number of progress lines in the log of a run.
PROGRESS_LINES = 20


def _now() -> datetime:
    return datetime.now().astimezone()


class RunLog:
    """The writer of log.txt, which every run registers in addition to the selected plugins.

    Args:
        folder: The run's folder; an existing log is continued.
        clock: Function that returns the local time.

    Raises:
        UserError: The log is a link or a pipe.
    """

    def __init__(self, folder: Path, clock: Callable[[], datetime] = _now) -> None:
        self._path = folder / FILE
        check_own(self._path)
        self._clock = clock
        self._pace = Pace(1)
        self._interval = 1
        self._missing = ""

    def write(self, text: str) -> None:
        """Append a text of one or more lines, each with the time of day.

        If the disk is full, the run continues without these lines. The next successful entry
        reports that lines are missing.
        """
        stamp = self._clock().strftime("%H:%M:%S")
        gap = [f"(lines are missing here: {self._missing})"] if self._missing else []
        lines = [f"{stamp}  {line}".rstrip() for line in (*gap, *showable(text).splitlines())]
        try:
            # Open the file for every entry, so that all entries are in the file if the run is
            # killed.
            with self._path.open("a", encoding="utf-8", errors="backslashreplace") as file:
                file.write("\n".join([*lines, ""]))
            self._missing = ""
        except OSError as error:
            self._missing = error.strerror or str(error)

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Write the date, the scene and the notes."""
        self._pace = Pace(run.schedule.total)
        self._interval = max(1, self._pace.total // PROGRESS_LINES)
        self.write(f"{self._clock():%Y-%m-%d}, scene {run.scene.name}, {self._pace.total} steps")
        for note in (*full_lines(run.decisions), *run.notes):
            self.write(note)

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Write a progress line at regular steps."""
        self._pace = self._pace.after(record)
        if record.step % self._interval == 0:
            self.write(progress_line(self._pace))

    @hookimpl
    def crossgrad_length_changed(self, total: int) -> None:
        """Use the new length for later progress lines."""
        self._pace = self._pace.with_length(total)

    @hookimpl
    def crossgrad_evaluation(self, report: EvaluationReport) -> None:
        """Write the metrics."""
        self._pace = self._pace.evaluated(report)
        self.write(evaluation_line(report))

    @hookimpl
    def crossgrad_log(self, text: str) -> None:
        """Write a message of the run."""
        self.write(text)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """Write the status of the run."""
        for line in length_lines(self._pace):
            self.write(line)
        self.write(f"run {status}")
