"""The process of a run: `crossgrad run` that stops, with a checkpoint, when its starter is gone.

    python -m crossgrad_plugins.sweep.child CORES ARGUMENT ...

CORES are the numbers of the cores that it may use, joined by commas, or `-` for any. Its standard
input is a pipe from its starter; where that ends, the run is asked to stop.
"""

import os
import runpy
import signal
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread

#: Standard input, which nothing is ever written to.
_PIPE = 0
#: Linux shares processors among sessions first; the `nice` of a process only counts within one.
_SESSION_NICENESS = Path("/proc/self/autogroup")


def main() -> None:
    """Runs the command line after the cores."""
    cores, *arguments = sys.argv[1:]
    if cores != "-" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    _be_as_nice_as_asked()
    Thread(target=_stop_when_alone, name="crossgrad-sweep", daemon=True).start()
    sys.argv = ["crossgrad", *arguments]
    runpy.run_module("crossgrad_core", run_name="__main__", alter_sys=False)


def _be_as_nice_as_asked() -> None:
    """Gives the session of this run, which is its own, the niceness of the process (`nice`)."""
    if (niceness := getattr(os, "nice", lambda _: 0)(0)) > 0:
        with suppress(OSError):  # Not Linux, or a Linux that shares in other ways.
            _SESSION_NICENESS.write_text(str(niceness), encoding="ascii")


def _stop_when_alone() -> None:
    while os.read(_PIPE, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
