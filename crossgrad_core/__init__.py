"""The Python interface: `import crossgrad_core as cg`, `cg.run(...)`, `cg.resume`, `cg.open`.

Each name is imported when it is first used; docs/python.md shows examples.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from crossgrad_core.system.cores import let_idle_threads_sleep
from crossgrad_core.system.version import VERSION

if TYPE_CHECKING:
    from crossgrad_core.contract.scene import Camera
    from crossgrad_core.errors import RunFailedError, UserError
    from crossgrad_core.run.api import resume, run
    from crossgrad_core.run.trained import Run, open  # noqa: A004

__version__ = VERSION

#: Public name -> module that defines the name.
_HOMES = {
    "Camera": "crossgrad_core.contract.scene",
    "Run": "crossgrad_core.run.trained",
    "RunFailedError": "crossgrad_core.errors",
    "UserError": "crossgrad_core.errors",
    "open": "crossgrad_core.run.trained",
    "resume": "crossgrad_core.run.api",
}

__all__ = ["Camera", "Run", "RunFailedError", "UserError", "__version__", "open", "resume", "run"]


def __getattr__(name: str) -> object:
    if name == "run" or name in _HOMES:
        let_idle_threads_sleep()
    if name == "run":  # Return the sub-package `run`, which can be called like a function.
        return import_module("crossgrad_core.run")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
