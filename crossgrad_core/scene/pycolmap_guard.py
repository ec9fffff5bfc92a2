"""Import of pycolmap without its side effects on the process."""

import signal
import sys
import threading


def guard_pycolmap() -> None:
    """Import pycolmap without side effects on the process; call this before importing it.

    pycolmap 4.2.1 exports the symbols of its own zlib. If pycolmap loads before the system's zlib,
    Pillow later mixes the two libraries, and writing a PNG aborts. Therefore zlib is imported
    first. pycolmap also installs a SIGTERM handler that prints a stack trace and ends the process
    without calling Python's handler. Therefore the former handler is restored.
    """
    if "pycolmap" in sys.modules:
        return
    import zlib  # noqa: F401

    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap  # noqa: F401

    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
