"""Progress of a run: a bar in a terminal or notebook, otherwise plain lines on stderr."""

import sys
from time import monotonic
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, PrivateAttr

from crossgrad_core.plugin import (
    EvaluationReport,
    Observer,
    Pace,
    RunInfo,
    StepRecord,
    controls_of,
    evaluation_line,
    figures,
    full_lines,
    hookimpl,
    length_lines,
    progress_line,
    short_lines,
    showable,
    shows_bar,
)

if TYPE_CHECKING:
    from tqdm import tqdm

_BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"

#: Counts that the progress display omits, because most steps report them.
_OF_AGGREGATION = frozenset({"zero", "disjoint", "dropped", "conflict"})


class Progress(Observer):
    """Shows step, loss, PSNR, primitives, speed and time left on stderr.

    Attributes:
        level: The amount of output.
        interval: Seconds between two plain lines; a line is also written after every tenth of the
            run.
    """

    level: Literal["quiet", "normal", "verbose"] = Field(
        "normal",
        description="quiet: print nothing; normal: scene, decisions, progress, evaluations, "
        "messages; verbose: also all notes and every change of density control",
    )
    interval: float = Field(
        10.0, gt=0.0, description="seconds between lines if the output is not a terminal"
    )

    # Variables of the display. These variables are not stored in checkpoints.
    _pace: Pace = PrivateAttr(default_factory=lambda: Pace(1))
    _tenth: int = PrivateAttr(default=1)
    _bar: "tqdm[Any] | None" = PrivateAttr(default=None)
    _last_line: float = PrivateAttr(default=0.0)

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Show the scene, the length, the device and the decisions.

        With level `verbose`, show all notes.
        """
        self._pace = Pace(run.schedule.total)
        self._tenth = max(1, self._pace.total // 10)
        self._last_line = monotonic()
        if self.level == "quiet":
            return
        train, test = len(run.scene.train), len(run.scene.test)
        length = f"{run.schedule.total:,} steps on {run.config['device']}"
        self._say(f"{run.scene.name}: {train} training views, {test} held out; {length}")
        if run.folder is not None:
            self._say(f"results in {run.folder}")
        verbose = self.level == "verbose"
        shown = (*full_lines(run.decisions), *run.notes) if verbose else short_lines(run.decisions)
        for line in shown:
            self._say(f"- {line}")
        if run.notes and not verbose:
            self._say(f"- more notes: {len(run.notes)} (in log.txt, or with -v)")

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Update the bar, or write a line at intervals."""
        if self.level == "quiet":
            return
        self._pace = self._pace.after(record)
        if shows_bar(sys.stderr):
            self._move_bar(record)
        elif self._line_is_due(record.step):
            self._last_line = monotonic()
            self._say(progress_line(self._pace))
        if self.level == "verbose":
            self._tell_changes(record)

    @hookimpl
    def crossgrad_length_changed(self, total: int) -> None:
        """Change the length of the bar."""
        self._pace = self._pace.with_length(total)
        if self._bar is not None:
            self._bar.total = total

    @hookimpl
    def crossgrad_evaluation(self, report: EvaluationReport) -> None:
        """Show the metrics."""
        self._pace = self._pace.evaluated(report)
        if self.level != "quiet":
            self._say(evaluation_line(report))

    @hookimpl
    def crossgrad_log(self, text: str) -> None:
        """Show a message of the run."""
        if self.level != "quiet":
            self._say(text)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """Keep the finished bar on the screen, and show how the run ended."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        if self.level == "quiet":
            return
        for line in length_lines(self._pace):
            self._say(line)
        if status != "finished":
            self._say(f"run {status}")

    def _tell_changes(self, record: StepRecord) -> None:
        changes = [
            f"{count:,} {name}"
            for name, count in record.counts.items()
            if count and name not in _OF_AGGREGATION
        ]
        if changes:
            self._say(f"step {record.step}: {', '.join(changes)}")

    def _line_is_due(self, step: int) -> bool:
        return step % self._tenth == 0 or monotonic() - self._last_line >= self.interval

    def _move_bar(self, record: StepRecord) -> None:
        from tqdm import tqdm

        if self._bar is None:
            self._bar = tqdm(
                total=self._pace.total,
                initial=self._pace.first,
                unit="step",
                bar_format=_BAR,
                dynamic_ncols=True,
                file=controls_of(sys.stderr),
            )
        self._bar.set_postfix_str(", ".join(figures(self._pace)), refresh=False)
        self._bar.update(record.step - self._bar.n)

    def _say(self, text: str) -> None:
        if self._bar is None:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()
        else:
            # `tqdm.write` prints the line above the bar. A normal print would damage the bar.
            self._bar.write(showable(text), file=controls_of(sys.stderr))
