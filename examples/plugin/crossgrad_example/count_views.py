"""The command `crossgrad count-views SCENE`."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import announce


def count_views(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder.")],
) -> None:
    """Count the training views of a scene."""
    announce()
    from crossgrad_core.commands import configured, read_scene

    found, reader = read_scene(configured({"scene": scene}))
    typer.echo(f"{found.name}: {len(found.train)} training views, read by {reader}")
