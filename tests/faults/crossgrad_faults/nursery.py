"""A process that has imported everything and runs each command line in a fork of itself.

    python nursery.py ARGUMENT ...

Runs the command line of its own arguments first, so that all kernels are loaded. Then it reads jobs
as JSON, one a line, and answers each with how it ended. A fork costs milliseconds where a new
interpreter costs seconds, so that a hundred runs can be killed in minutes.

job:    {"arguments": [...], "output": FILE, "fault": {...} or null, "signals": [[seconds, number]],
         "environment": {...}}
answer: {"code": exit status or minus the signal, "seconds": wall time, "events": writes counted}
"""

import contextlib
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
#: Environment of the process: no thread besides the first one.
ALONE = {
    "NUMBA_NUM_THREADS": "1",
    "NUMBA_THREADING_LAYER": "workqueue",
    "OMP_NUM_THREADS": "1",
}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def main() -> None:
    """Answers jobs until the input ends."""
    load_everything(sys.argv[1:])
    tell({"ready": True})
    for line in sys.stdin:
        tell(answer(json.loads(line)))


def tell(value: object) -> None:
    """Writes one line to the parent."""
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def load_everything(arguments: list[str]) -> None:
    """Runs a command line in this process: what it imports and compiles, every fork then has.

    Numba's threads would not survive a fork; `ALONE` keeps it from starting any. In the short
    version of the suite runs write a curve of one pixel.
    """
    from support.curves import without_drawing

    from crossgrad_core.cli.main import main as command
    from crossgrad_core.run import session

    if "FAULTS" not in os.environ:
        session.draw_curve = without_drawing
    with contextlib.redirect_stdout(sys.stderr), contextlib.suppress(SystemExit):
        command(arguments)


def answer(job: Mapping[str, Any]) -> dict[str, Any]:
    """Runs one job in a fork and waits for it."""
    read, write = os.pipe()
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(read)
        run(job, write)
    os.close(write)
    signals = [(at, number) for at, number in job["signals"]]
    status = attended(child, start, signals, Path(job["output"]))
    with os.fdopen(read) as pipe:
        events = pipe.read()
    code = os.waitstatus_to_exitcode(status)
    return {"code": code, "seconds": time.monotonic() - start, "events": int(events or 0)}


def attended(child: int, start: float, signals: list[tuple[float, int]], output: Path) -> int:
    """Sends the signals in time and returns the wait status of the child.

    What a command answers is sent once it has said its first line: only then are its handlers
    surely there, however busy the machine is.
    """
    for at, number in signals:
        answered = number != signal.SIGKILL
        while time.monotonic() - start < at or (answered and not has_spoken(output)):
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid:
                return status
            time.sleep(0.002)
        os.kill(child, number)
    return os.waitpid(child, 0)[1]


def has_spoken(output: Path) -> bool:
    """Whether a command line has said anything."""
    return output.exists() and output.stat().st_size > 0


def run(job: Mapping[str, Any], report: int) -> None:
    """Inside the fork: runs the command line with its fault; never returns."""
    output = os.open(job["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(output, 1)
    os.dup2(output, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.update(job["environment"])
    own_locks()
    told = Counter()
    if job["fault"] is not None:
        install(job["fault"], told)
    code = 1
    try:
        from crossgrad_core.__main__ import main as command

        sys.argv = ["crossgrad", *job["arguments"]]
        command()
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


def own_locks() -> None:
    """Renews the one lock that forks share: one that is killed with it would stop all others."""
    from numba.np.ufunc import parallel

    parallel._set_init_process_lock()


@dataclass
class Counter:
    """Counts changes of the disk."""

    count: int = 0


def install(fault: Mapping[str, Any], told: Counter) -> None:
    """Counts the changes below a folder and acts at the given one.

    fault: {"below": FOLDER, "at": n or 0 to count only, "what": name of an act, "file": FILE}
    """
    below, at = fault["below"], fault["at"]
    act = ACTS[fault["what"]](fault)

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


#: What happens at a change of the disk.
Act = Callable[[str, tuple[Any, ...]], None]


def kill(_fault: Mapping[str, Any]) -> Act:
    """As `kill -9` does, right before the change."""
    return lambda _event, _arguments: os.kill(os.getpid(), signal.SIGKILL)


def full(_fault: Mapping[str, Any]) -> Act:
    """As a disk without room does from here on; deleting and renaming still work."""

    def act(event: str, arguments: tuple[Any, ...]) -> None:
        if event in NEEDS_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))

    return act


def readonly(_fault: Mapping[str, Any]) -> Act:
    """As a file system does that was mounted read-only after an error."""

    def act(_event: str, arguments: tuple[Any, ...]) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(arguments[0]))

    return act


def rot(fault: Mapping[str, Any]) -> Act:
    """Overwrites the middle of a file, once."""
    return once(lambda path: path.write_bytes(path.read_bytes()[:200] + bytes(200)), fault)


def vanish(fault: Mapping[str, Any]) -> Act:
    """Deletes a file, once."""
    return once(Path.unlink, fault)


def once(change: Callable[[Path], object], fault: Mapping[str, Any]) -> Act:
    """An act that changes the fault's file where that was not done yet."""
    left = [Path(fault["file"])]

    def act(_event: str, _arguments: tuple[Any, ...]) -> None:
        if left:
            change(left.pop())

    return act


def jump(_fault: Mapping[str, Any]) -> Act:
    """Moves every clock that the code has imported forward, then back."""
    shift = [1e6]

    def act(_event: str, _arguments: tuple[Any, ...]) -> None:
        shift[0] = -shift[0]
        for name, module in list(sys.modules.items()):
            if name.startswith("crossgrad_"):
                for clock in (time.perf_counter, time.monotonic):
                    moved = shifted(clock, shift[0])
                    vars(module).update(
                        {
                            key: moved
                            for key, value in vars(module).items()
                            if is_clock(value, clock)
                        }
                    )

    return act


def is_clock(value: object, clock: Callable[[], float]) -> bool:
    """Whether a module's name stands for the clock, moved or not."""
    return value is clock or getattr(value, "clock", None) is clock


def shifted(clock: Callable[[], float], by: float) -> Callable[[], float]:
    """The clock, moved by some seconds."""

    def moved() -> float:
        return clock() + by

    moved.clock = clock  # type: ignore[attr-defined]
    return moved


ACTS: Mapping[str, Callable[[Mapping[str, Any]], Act]] = {
    "kill": kill,
    "full": full,
    "readonly": readonly,
    "rot": rot,
    "vanish": vanish,
    "jump": jump,
}

if __name__ == "__main__":
    main()
