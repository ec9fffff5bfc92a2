"""`crossgrad compare`: runs against each other, over seeds, scenes, regimes and budgets."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import announce
from crossgrad_plugins.compare.cost import ClockChoice

_WHAT = "What is compared"
_ARMS = "Arms"


def compare(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...|FOLDER",
            help="Folders of runs, or folders with runs below, such as that of a sweep.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the page, the figures and the tables; an earlier comparison in it is "
            "replaced, nothing else is. Default: compare, beside the runs.",
        ),
    ] = None,
    metric: Annotated[
        str,
        typer.Option(metavar="NAME", help="The figure that is compared.", rich_help_panel=_WHAT),
    ] = "psnr",
    margin: Annotated[
        float | None,
        typer.Option(
            min=1e-9,
            metavar="X",
            help="What counts as no difference; fix it before you look. Default: 0.1 dB, "
            "0.005 of SSIM and LPIPS.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    clock: Annotated[
        ClockChoice,
        typer.Option(
            help="Seconds of the clock, of the processor, or none. auto: of the clock if all runs "
            "had one quiet machine, else of the processor.",
            rich_help_panel=_WHAT,
        ),
    ] = ClockChoice.AUTO,
    target: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Quality to reach. Default: on each scene what the weakest arm ends with.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(
            metavar="ARM",
            help="Compare the other arms with this one only. Default: all with all.",
            rich_help_panel=_ARMS,
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OLD:NEW", help="Another name for an arm, repeatable.", rich_help_panel=_ARMS
        ),
    ] = None,
    skip_broken: Annotated[
        bool,
        typer.Option("--skip-broken", help="Leave out runs with damaged files, and list them."),
    ] = False,
) -> None:
    """Compare runs: what won, by how much, how sure, at what cost.

    Groups runs by what differs in their configurations, pairs them by scene and seed, and writes
    one page, figures for a paper and CSV tables. What does not compare is refused.
    """
    announce()
    from crossgrad_plugins.compare import app
    from crossgrad_plugins.compare.comparison import Options

    options = Options(
        metric=metric,
        margin=margin,
        baseline=baseline,
        clock=clock,
        target=target,
        names=tuple(name or ()),
    )
    app.compare(runs, options, out, skip_broken=skip_broken)
