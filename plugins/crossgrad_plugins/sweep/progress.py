"""The screen of a sweep: one live table on a terminal, elsewhere a line for each end."""

import sys
from datetime import UTC, datetime
from shutil import get_terminal_size
from time import monotonic
from typing import Final

from crossgrad_core.commands import controls_of, is_live, one_line
from crossgrad_plugins.sweep.estimate import duration, estimated
from crossgrad_plugins.sweep.records import Record, read_records
from crossgrad_plugins.sweep.watch import UnderWay, Watch

#: Seconds between two looks at the records, and failures that the live table shows.
PAUSE: Final = 1.0
MOST_FAILURES: Final = 8


class Screen:
    """Shows a sweep on stderr.

    Args:
        watch: What happened.
        at_a_time: How many runs are trained at a time.
    """

    def __init__(self, watch: Watch, at_a_time: int) -> None:
        self._watch = watch
        self._at_a_time = at_a_time
        self._live = is_live(sys.stderr)
        self._lines = 0
        self._last = 0.0

    def show(self, *, at_once: bool = False) -> None:
        """Looks at the records and shows what is new, once a second at most."""
        if monotonic() - self._last < PAUSE and not at_once:
            return
        self._last = monotonic()
        ends = self._watch.look()
        if self._live:
            self._draw([*self._table(), *self._failures()])
        else:
            for record in ends:
                _write(f"... {one_line(self._end(record))}\n")

    def close(self) -> None:
        """Shows the last state; a live table stays on the screen."""
        self.show(at_once=True)

    def _draw(self, lines: list[str]) -> None:
        width = get_terminal_size().columns
        up = f"\x1b[{self._lines}F" if self._lines else ""
        shown = "".join(f"\x1b[K{one_line(line)[: width - 1]}\n" for line in lines)
        _write(f"{up}{shown}\x1b[J")
        self._lines = len(lines)

    def _table(self) -> list[str]:
        watch = self._watch
        total, left = len(watch.before), len(watch.left)
        jobs = {each.job.id: each.job for each in watch.before}
        time = estimated(watch.left, jobs, read_records(watch.layout.records))
        counts = f"{watch.finished} of {total} finished, {len(watch.failed)} failed, {left} left"
        return [f"{counts}; {time.text(self._at_a_time)}", *map(_line, watch.under_way)]

    def _failures(self) -> list[str]:
        failed = self._watch.failed
        shown = [f"  failed: {self._end(each)}" for each in failed[-MOST_FAILURES:]]
        more = len(failed) - len(shown)
        return [*([f"  {more} earlier failures"] if more else []), *shown]

    def _end(self, record: Record) -> str:
        """How a run ended, in one line."""
        watch = self._watch
        took = "" if record.seconds is None else f" after {duration(record.seconds)}"
        reason = f": {' '.join((record.error or '').split())}" if record.error else ""
        count = f"{watch.finished} of {len(watch.before)}"
        return f"{count}  {watch.job(record).title}: {record.status}{took}{reason}"


def _line(each: UnderWay) -> str:
    passed = duration((datetime.now(UTC) - each.record.when).total_seconds())
    cells = [f"{name} {each.row[name][:7]}" for name in ("step", "psnr") if each.row.get(name)]
    return f"  {each.record.worker:>8}  {each.job.title}  {passed}  {'  '.join(cells)}".rstrip()


def _write(text: str) -> None:
    stream = controls_of(sys.stderr)
    stream.write(text)
    stream.flush()
