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
    """Check whether points, poses and photos of a scene match.

    Compares the colours of the SfM points with the photos at the projected positions, as each run
    does at its start. Prints the photos that do not match, the changes to the input, and the
    verdict. A scene that does not match as a whole is refused with the likely cause (exit code 2).
    """
    announce(quiet=False)
    from crossgrad_plugins.scene_check import app

    for line in app.lines_of(scene, assignments or []):
        print(line)  # noqa: T201 - print the result of the command
