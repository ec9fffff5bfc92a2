"""The process of a run: `crossgrad run` that stops, with a checkpoint, when its starter is gone.

    python -m crossgrad_plugins.sweep.child CORES ARGUMENT ...

CORES are the numbers of the cores that it may use, joined by commas, or `-` for any. Its standard
input is a pipe from its starter; where that ends, the run is asked to stop.
"""

import os
import runpy
import signal
import sys
from threading import Thread

#: Standard input, which nothing is ever written to.
_PIPE = 0


def main() -> None:
    """Runs the command line after the cores."""
    cores, *arguments = sys.argv[1:]
    if cores != "-" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    Thread(target=_stop_when_alone, name="crossgrad-sweep", daemon=True).start()
    sys.argv = ["crossgrad", *arguments]
    runpy.run_module("crossgrad_core", run_name="__main__", alter_sys=False)


def _stop_when_alone() -> None:
    while os.read(_PIPE, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
