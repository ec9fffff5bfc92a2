"""`crossgrad stress`: operators against exact arithmetic on stiff and extreme gradients."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.startup import announce

#: Elements of the largest gradients.
LARGE = 10_000_000


def stress(
    operators: Annotated[
        list[str] | None,
        typer.Argument(metavar="OPERATOR...", help="Names of operators. Default: all installed."),
    ] = None,
    case: Annotated[
        str, typer.Option(metavar="TEXT", help="Only cases whose name contains this text.")
    ] = "",
    elements: Annotated[
        int, typer.Option(min=1000, metavar="N", help="Elements of the largest gradients.")
    ] = LARGE,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the table to a CSV file.")
    ] = None,
) -> None:
    """Hold operators against 50-digit arithmetic; exit status 1 if one breaks its promise."""
    announce()
    from crossgrad_core.stress.cases import cases
    from crossgrad_core.stress.suite import installed, run_suite
    from crossgrad_core.stress.table import as_text, failed, write_csv
    from crossgrad_core.writability import check_file

    if csv is not None:
        check_file(csv)
    chosen = [each for each in cases(large=elements) if case in each.name]
    cells = list(run_suite(operators or installed(), chosen, progress=_progress))
    typer.echo(as_text(cells))
    if csv is not None:
        write_csv(cells, csv)
    if failed(cells):
        raise typer.Exit(1)


def _progress(name: str) -> None:
    typer.echo(f"... {name}", err=True)
