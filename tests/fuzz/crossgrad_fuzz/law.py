"""Conditions that every execution must fulfil for any input."""

import contextlib
import os
import tempfile
import traceback
import unicodedata
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.wording import showable
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.limits import TooSlowError, cpu_limit, memory_limit
from crossgrad_fuzz.target import Target

#: An error is read in a terminal.
LONGEST_MESSAGE = 3200
#: Kind of the finding that an execution took more than its CPU seconds.
SLOW = "slow"


@dataclass(frozen=True)
class Finding:
    """A law that did not hold.

    Attributes:
        kind: What is wrong, the same for all inputs that show the same fault.
        detail: The trace or the message.
    """

    kind: str
    detail: str


class Bench:
    """A folder in which one target's inputs are parsed, one after the other.

    Args:
        target: The parser.
        folder: Empty; on a file system in memory, if possible.
    """

    def __init__(self, target: Target, folder: Path) -> None:
        self.target = target
        self.folder = folder / "input"
        self._temporary = folder / "temporary"
        self.folder.mkdir(parents=True)
        self._temporary.mkdir()
        target.prepare(self.folder)
        self._constant = self._listing()
        self._there: dict[str, bytes] = {}

    def warm_up(self, cases: Iterable[Case]) -> None:
        """Parses valid inputs without any bound: what is imported and compiled then counts not."""
        for case in cases:
            self._put(case)
            with warnings.catch_warnings(), contextlib.suppress(UserError):
                warnings.simplefilter("ignore")
                self.target.parse(self.folder)
            self._clear()

    def execute(self, case: Case) -> Finding | None:
        """Parses one input; what was wrong, if anything."""
        self._put(case)
        before = self._listing()
        finding, succeeded = self._parsed()
        if finding is not None and finding.kind == SLOW:
            # The clock counts all threads of the process; a slow parser is slow twice.
            finding, succeeded = self._parsed()
        changed = self._listing().items() ^ before.items()
        wrong = {name for name, _ in changed} - (self.target.writes if succeeded else frozenset())
        if changed:
            self._clear()
        if finding is None and wrong:
            finding = Finding("writes", f"changed, made or removed: {sorted(wrong)}")
        return finding

    def _parsed(self) -> tuple[Finding | None, bool]:
        target = self.target
        usual, tempfile.tempdir = tempfile.tempdir, os.fspath(self._temporary)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error" if target.quiet else "ignore")
                with memory_limit(target.mebibytes), cpu_limit(target.seconds):
                    target.parse(self.folder)
        except UserError as error:
            return complaint(error), False
        except TooSlowError:
            return Finding(SLOW, f"more than {target.seconds:g} CPU seconds"), False
        except Exception as error:
            return Finding(_signature(error), traceback.format_exc()), False
        finally:
            tempfile.tempdir = usual
        return None, True

    def _put(self, case: Case) -> None:
        for name in self._there.keys() - case.keys():
            (self.folder / name).unlink()
        for name, content in case.items():
            if self._there.get(name) != content:
                path = self.folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        self._there = dict(case)

    def _listing(self) -> dict[str, tuple[int, int]]:
        """Path -> size and time of change of all files."""
        found: dict[str, tuple[int, int]] = {}
        places = [(os.fspath(self.folder), ""), (os.fspath(self._temporary), "../temporary/")]
        while places:
            place, prefix = places.pop()
            with os.scandir(place) as entries:
                for entry in entries:
                    name = prefix + entry.name
                    if entry.is_dir(follow_symlinks=False):
                        places.append((entry.path, name + "/"))
                        continue
                    status = entry.stat(follow_symlinks=False)
                    found[name] = (status.st_size, status.st_mtime_ns)
        return found

    def _clear(self) -> None:
        """Removes everything but the constant files."""
        for name in self._listing().keys() - self._constant.keys():
            (self.folder / name).unlink()
        self._there = {}


def complaint(error: UserError) -> Finding | None:
    """What is wrong with an error's words."""
    message = error.message()
    faults = []
    if not error.where:
        faults.append("no where")
    if not error.todo:
        faults.append("no todo")
    if len(message) > LONGEST_MESSAGE:
        faults.append("too long")
    if any(unicodedata.category(c) in {"Cc", "Cs"} and c != "\n" for c in message):
        faults.append("control characters")
    if not faults:
        return None
    return Finding(f"{showable(error.what)[:40]}: {', '.join(faults)}", message)


def _signature(error: BaseException) -> str:
    """The type and the innermost place in our own code."""
    ours = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "/crossgrad_" in frame.filename and "crossgrad_fuzz" not in frame.filename
    ]
    place = f"{Path(ours[-1].filename).name}:{ours[-1].name}:{ours[-1].lineno}" if ours else "?"
    return f"{type(error).__name__} in {place}"
