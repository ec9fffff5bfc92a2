"""Import pycolmap without its side effects on the process."""

import signal
import sys
import threading


def guard_pycolmap() -> None:
    """Import pycolmap without side effects on the process.

    Call this function before any import of pycolmap.

    pycolmap 4.2.1 contains its own zlib and exports the symbols of this library. If pycolmap is
    loaded before the system's zlib, Pillow later mixes both libraries, and writing a PNG file
    aborts the process. To avoid this abort, zlib is imported first. pycolmap also installs a
    SIGTERM handler, which ends the process without calling Python's handler. The function therefore
    restores the previous handler.
    """
    if "pycolmap" in sys.modules:
        return
    import zlib  # noqa: F401

    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap  # noqa: F401

    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
