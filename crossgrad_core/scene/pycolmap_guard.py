"""Imports pycolmap without its side effects on the process."""

import signal
import sys
import threading


def guard_pycolmap() -> None:
    """Imports pycolmap such that the rest of the process works as before; call before importing it.

    pycolmap 4.2.1 exports the symbols of a zlib of its own. If it is what brings the system's zlib
    into the process, Pillow later mixes the two, and writing a PNG aborts; so zlib goes first. It
    also installs a handler of SIGTERM that prints a stack trace and ends the process, past any
    handler of Python.
    """
    if "pycolmap" in sys.modules:
        return
    import zlib  # noqa: F401

    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap  # noqa: F401

    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
