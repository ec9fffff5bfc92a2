"""The command `crossgrad check` and its options."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import announce


def check(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help="Scene folder.", show_default=False),
    ],
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="One setting of the scene, such as reader=colmap or data.max_size=800. "
            "Repeatable.",
        ),
    ] = None,
) -> None:
    """Check if points, poses and photos of a scene match.

    The command compares the colours of SfM points with the photos at the projected positions. Each
    run does this at its start, too. It prints photos that do not match, changes to the input, and
    the verdict. If the whole scene does not match, it is refused with the likely cause (exit code
    2).
    """
    announce(quiet=False)
    from crossgrad_plugins.scene_check import app

    for line in app.lines_of(scene, assignments or []):
        print(line)  # noqa: T201 - print the result of the command
