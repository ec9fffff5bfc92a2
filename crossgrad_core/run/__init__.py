"""A run from its settings to its results, and what is done with it afterwards.

The module can be called: `crossgrad_core.run("SCENE", operator="pcgrad")` is `api.run`. A function
of that name in `crossgrad_core` would hide this package, or be hidden by it.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from crossgrad_core.run.trained import Run


class _Room(ModuleType):
    def __call__(
        self,
        scene: "Path | str | None" = None,
        *,
        config: "Path | str | None" = None,
        quiet: bool = False,
        verbose: bool = False,
        **options: object,
    ) -> "Run":
        """Trains a scene, evaluates and exports it; see `crossgrad_core.run.api.run`."""
        from crossgrad_core.run.api import run

        return run(scene, config=config, quiet=quiet, verbose=verbose, **options)


sys.modules[__name__].__class__ = _Room
