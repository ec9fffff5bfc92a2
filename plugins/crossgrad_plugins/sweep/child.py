"""The process of a run: `crossgrad run`, which stops with a checkpoint if its parent ends.

    Usage: python -m crossgrad_plugins.sweep.child CORES ARGUMENT ...

CORES are the numbers of the allowed cores, joined by commas, or `-` for any core. The standard
input is a pipe from the parent process. When the pipe closes, the run is asked to stop.
"""

import os
import runpy
import signal
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread

#: File descriptor of the standard input. The parent never writes to it.
_PIPE = 0
#: Linux first divides the processor time among sessions. The `nice` value of a process counts only
#: within its session.
_SESSION_NICENESS = Path("/proc/self/autogroup")


def main() -> None:
    """Run the command line that follows the core numbers."""
    cores, *arguments = sys.argv[1:]
    if cores != "-" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    _be_as_nice_as_asked()
    Thread(target=_stop_when_alone, name="crossgrad-sweep", daemon=True).start()
    sys.argv = ["crossgrad", *arguments]
    runpy.run_module("crossgrad_core", run_name="__main__", alter_sys=False)


def _be_as_nice_as_asked() -> None:
    """Give the session of this run the `nice` value of its process."""
    if (niceness := getattr(os, "nice", lambda _: 0)(0)) > 0:
        # This fails if the system is not Linux or does not schedule by sessions.
        with suppress(OSError):
            _SESSION_NICENESS.write_text(str(niceness), encoding="ascii")


def _stop_when_alone() -> None:
    while os.read(_PIPE, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
