"""A process that has imported everything and runs each command line in a fork of itself.

    python nursery.py

Reads jobs as JSON, one a line, and answers each with how it ended. A fork costs milliseconds where
a new interpreter costs seconds, so that a hundred runs can be killed in minutes.

job:    {"arguments": [...], "output": FILE, "fault": {...} or null, "signals": [[seconds, number]]}
answer: {"code": exit status or minus the signal, "seconds": wall time, "events": writes counted}
"""

import errno
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Audit events that change what is on the disk, besides opening for writing.
CHANGES = frozenset({"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"})
#: Events that a full disk refuses; it lets go of files.
NEEDS_ROOM = frozenset({"open", "os.mkdir"})
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def main() -> None:
    """Answers jobs until the input ends."""
    import_everything()
    tell({"ready": True})
    for line in sys.stdin:
        tell(answer(json.loads(line)))


def tell(value: object) -> None:
    """Writes one line to the parent."""
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def import_everything() -> None:
    """Loads what a run imports; no kernel runs yet, since its threads would not survive a fork."""
    import matplotlib.pyplot
    import skimage.metrics
    import torch

    import crossgrad_core.cli.main

    assert crossgrad_core.cli.main
    assert matplotlib.pyplot
    assert skimage.metrics
    assert torch


def answer(job: Mapping[str, Any]) -> dict[str, Any]:
    """Runs one job in a fork and waits for it."""
    read, write = os.pipe()
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(read)
        run(job, write)
    os.close(write)
    status = attended(child, start, [(at, number) for at, number in job["signals"]])
    with os.fdopen(read) as pipe:
        events = pipe.read()
    code = os.waitstatus_to_exitcode(status)
    return {"code": code, "seconds": time.monotonic() - start, "events": int(events or 0)}


def attended(child: int, start: float, signals: list[tuple[float, int]]) -> int:
    """Sends the signals in time and returns the wait status of the child."""
    for at, number in signals:
        while time.monotonic() - start < at:
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid:
                return status
            time.sleep(0.002)
        os.kill(child, number)
    return os.waitpid(child, 0)[1]


def run(job: Mapping[str, Any], report: int) -> None:
    """Inside the fork: runs the command line with its fault; never returns."""
    output = os.open(job["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(output, 1)
    os.dup2(output, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    told = Counter()
    if job["fault"] is not None:
        install(job["fault"], told)
    code = 1
    try:
        from crossgrad_core.cli.main import main as command

        command(job["arguments"])
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os.write(report, str(told.count).encode())
        os._exit(code)


@dataclass
class Counter:
    """Counts changes of the disk."""

    count: int = 0


def install(fault: Mapping[str, Any], told: Counter) -> None:
    """Counts the changes below a folder and acts at the given one.

    fault: {"below": FOLDER, "at": n or 0 to count only, "what": "kill" | "full" | "readonly"}
    """
    below, at, what = fault["below"], fault["at"], fault["what"]
    act = ACTS[what]

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if not concerns(event, arguments, below):
            return
        told.count += 1
        if at and told.count >= at:
            act(event, arguments)

    sys.addaudithook(hook)


def concerns(event: str, arguments: tuple[Any, ...], below: str) -> bool:
    """Whether an event changes something below the folder."""
    if event == "open":
        path, _mode, flags = arguments
        if not isinstance(flags, int) or not flags & WRITING:
            return False
    elif event in CHANGES:
        path = arguments[0]
    else:
        return False
    if isinstance(path, int):
        return False
    return str(Path(os.fsdecode(path)).absolute()).startswith(below)


def kill(event: str, arguments: tuple[Any, ...]) -> None:
    """As `kill -9` does, right before the change."""
    os.kill(os.getpid(), signal.SIGKILL)


def full(event: str, arguments: tuple[Any, ...]) -> None:
    """As a disk without room does from here on; deleting and renaming still work."""
    if event in NEEDS_ROOM:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))


def readonly(event: str, arguments: tuple[Any, ...]) -> None:
    """As a file system does that was mounted read-only after an error."""
    raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(arguments[0]))


ACTS: Mapping[str, Callable[[str, tuple[Any, ...]], None]] = {
    "kill": kill,
    "full": full,
    "readonly": readonly,
}

if __name__ == "__main__":
    main()
