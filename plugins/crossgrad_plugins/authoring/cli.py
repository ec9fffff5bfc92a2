"""List, explain, check and create plugins."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import (
    COMMANDS,
    OFFERED,
    OWN_COMMANDS,
    Entry,
    GroupedCommand,
    UserError,
    announce,
    did_you_mean,
    listed,
    offers,
    plural,
    sentences,
    strays,
    unmet_requirement,
)

app = typer.Typer(
    help="List, explain, check and create plugins.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

SlotOption = Annotated[
    str | None,
    typer.Option(
        "--slot", metavar="SLOT", help=f"Restrict the command to this slot: {listed(OFFERED)}."
    ),
]


PackageArgument = Annotated[
    str,
    typer.Argument(
        metavar="PACKAGE", help="An installed package: its name in pip, or its import name."
    ),
]


@app.callback(invoke_without_command=True)
def plugins(context: typer.Context) -> None:
    """List, explain, check and create plugins. Without a command, list the plugins."""
    if context.invoked_subcommand is None:
        list_plugins(None)


@app.command("list", cls=GroupedCommand)
def list_plugins(slot: SlotOption = None) -> None:
    """Show the installed plugins by slot, and the commands they add."""
    for group in _slots(slot):
        typer.echo(group)
        typer.echo("\n".join(_rows(offers(group))) or "  none installed")
    if lost := [f"  {stray.name}  {stray.origin}: {stray.reason}" for stray in strays()]:
        typer.echo("\n".join(["never read", *lost]))
    typer.echo("\n`crossgrad plugins show NAME` explains a plugin.")


@app.command("show", cls=GroupedCommand)
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a plugin.")],
    slot: SlotOption = None,
) -> None:
    """Show the purpose, the options and the origin of a plugin."""
    from crossgrad_plugins.authoring.describe import describe

    installed = [entry for group in _slots(slot) for entry in offers(group)]
    chosen = [entry for entry in installed if entry.name == name]
    if not chosen:
        slots = [group for group in _slots(None) if any(e.name == name for e in offers(group))]
        raise UserError(
            f"there is no plugin named {name!r}" + (f" among the {slot}" if slot else ""),
            found=f"a plugin with this name among the {listed(slots)}" if slots else "",
            todo=sentences(
                did_you_mean(name, [entry.name for entry in installed]),
                "`crossgrad plugins list` shows all plugins",
            ),
        )
    typer.echo("\n\n".join(describe(entry) for entry in chosen))


@app.command("check", cls=GroupedCommand)
def check(
    package: PackageArgument,
) -> None:
    """Run the contract checks of a package's plugins.

    Every plugin of the package is loaded and tested with the checks of its slot.
    Exit status: 0 if all plugins pass, 1 if a plugin fails.
    """
    from crossgrad_plugins.authoring.check import check_package

    report, passed = check_package(package)
    typer.echo(report)
    if not passed:
        raise typer.Exit(1)


@app.command("matrix", cls=GroupedCommand)
def matrix(
    package: PackageArgument,
    full: Annotated[
        bool,
        typer.Option(
            "--full/--pairwise",
            help="Test all combinations; the default is a smaller set that contains every "
            "pair of a component of the package and any other component.",
        ),
    ] = False,
    only: Annotated[
        str | None,
        typer.Option(
            "--only", metavar="COMBINATION", help="Test one combination, in the form of the report."
        ),
    ] = None,
) -> None:
    """Train a package's components with all others for a few steps.

    Each combination of installed components trains a tiny scene twice. Losses and parameters must
    be finite, and both trainings must give equal results. A combination that is refused before
    training, with a reason, does not count as a failure. Exit status: 0 if every combination trains
    or is refused, else 1.
    """
    announce()
    from crossgrad_plugins.authoring.matrix.report import train_matrix, train_one

    if only is not None:
        train_one(package, only)
        typer.echo(f"trained: {only}")
        return
    text, passed = train_matrix(package, full=full)
    typer.echo(text)
    if not passed:
        raise typer.Exit(1)


@app.command("new", cls=GroupedCommand)
def new(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the plugin and of its package.")
    ],
    slot: Annotated[
        str, typer.Option("--slot", metavar="SLOT", help=f"Slot of the plugin: {listed(OFFERED)}.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of the package. Default: NAME."),
    ] = None,
) -> None:
    """Create a small package with one plugin as a starting point.

    The package contains a pyproject.toml, one module and one test, and passes `crossgrad plugins
    check`. Nothing is overwritten.
    """
    from crossgrad_plugins.authoring.new import write_package

    (wanted,) = _slots(slot)
    folder = out or Path(name)
    files = write_package(name, wanted, folder)
    typer.echo("\n".join(f"wrote {path}" for path in files))
    typer.echo(f"\npip install -e {folder}\ncrossgrad plugins check {name}")


def _slots(slot: str | None) -> tuple[str, ...]:
    if slot is None:
        return tuple(OFFERED)
    group = slot if slot in OFFERED else plural(slot)
    if group not in OFFERED:
        raise UserError(
            f"there is no slot named {slot!r}",
            expected=f"one of {listed(OFFERED)}",
            todo=sentences(did_you_mean(slot, OFFERED), "`crossgrad plugins list` shows all slots"),
        )
    return (group,)


def _rows(offered: tuple[Entry, ...]) -> list[str]:
    names = [entry.name for entry in offered]
    width = max((len(name) for name in names), default=0)
    rows = []
    for entry in offered:
        note = ""
        if names.count(entry.name) > 1:
            note = "  two packages offer this name: choosing it is an error"
        if entry.slot == COMMANDS and entry.name in OWN_COMMANDS:
            note = "  never called: the core has a command with this name"
        if required := unmet_requirement(entry.distribution):
            note = f"  cannot be chosen: it requires {required}"
        rows.append(f"  {entry.name:<{width}}  {entry.distribution} {entry.version}{note}")
    return rows
