"""log.txt: plain text of what the terminal showed, with the time of day."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from crossgrad_core.contract.contexts import EvaluationReport, RunInfo, StepRecord
from crossgrad_core.contract.markers import hookimpl
from crossgrad_core.recipe.lines import full_lines
from crossgrad_core.run.results.lines import Pace, evaluation_line, length_lines, progress_line
from crossgrad_core.system.check_writable import check_own
from crossgrad_core.wording import showable

FILE = "log.txt"
#: Progress goes into the log so many times in a run.
PROGRESS_LINES = 20


def _now() -> datetime:
    return datetime.now().astimezone()


class RunLog:
    """Appends to log.txt; a plugin that the loop registers beside the selected ones.

    Args:
        folder: The run's folder; a log that is there already is continued.
        clock: The local time.

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
        """Appends a text of one or more lines, each with the time of day.

        A log that cannot be written (a full disk) ends no run: lines are left out, and the next one
        that can be written says so.
        """
        stamp = self._clock().strftime("%H:%M:%S")
        gap = [f"(lines are missing here: {self._missing})"] if self._missing else []
        lines = [f"{stamp}  {line}".rstrip() for line in (*gap, *showable(text).splitlines())]
        try:
            # Opened for every entry, so that the file is complete whenever the run is interrupted.
            with self._path.open("a", encoding="utf-8", errors="backslashreplace") as file:
                file.write("\n".join([*lines, ""]))
            self._missing = ""
        except OSError as error:
            self._missing = error.strerror or str(error)

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Writes the date, the scene and the notes."""
        self._pace = Pace(run.schedule.total)
        self._interval = max(1, self._pace.total // PROGRESS_LINES)
        self.write(f"{self._clock():%Y-%m-%d}, scene {run.scene.name}, {self._pace.total} steps")
        for note in (*full_lines(run.decisions), *run.notes):
            self.write(note)

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Writes progress now and then."""
        self._pace = self._pace.after(record)
        if record.step % self._interval == 0:
            self.write(progress_line(self._pace))

    @hookimpl
    def crossgrad_length_changed(self, total: int) -> None:
        """Notes the length that progress is now measured against."""
        self._pace = self._pace.with_length(total)

    @hookimpl
    def crossgrad_evaluation(self, report: EvaluationReport) -> None:
        """Writes the metrics."""
        self._pace = self._pace.evaluated(report)
        self.write(evaluation_line(report))

    @hookimpl
    def crossgrad_log(self, text: str) -> None:
        """Writes what the run says."""
        self.write(text)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """Writes how the run ended."""
        for line in length_lines(self._pace):
            self.write(line)
        self.write(f"run {status}")
