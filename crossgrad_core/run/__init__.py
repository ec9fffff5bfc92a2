"""A run from its settings to its results, and all later work on a trained run.

This module is callable: `crossgrad_core.run("SCENE", operator="pcgrad")` calls `api.run`. A
function `run` in `crossgrad_core` would hide this package, or this package would hide the function.
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
        """Train a scene, evaluate and export it; see `crossgrad_core.run.api.run`."""
        from crossgrad_core.run.api import run

        return run(scene, config=config, quiet=quiet, verbose=verbose, **options)


sys.modules[__name__].__class__ = _Room
