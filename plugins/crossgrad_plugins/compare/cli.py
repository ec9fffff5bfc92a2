"""`crossgrad compare`: compare runs over seeds, scenes, regimes and budgets."""

from crossgrad_core.commands import announce, command_of
from crossgrad_plugins.compare.options import Command


@command_of(Command)
def compare(options: Command) -> None:
    """Compare runs: quality with confidence intervals, and costs.

    Runs are grouped into arms by the settings that differ. Arms are paired by scene and seed. The
    output is a page, figures for a paper, and CSV tables. Runs that cannot be compared are refused.
    """
    announce()
    from crossgrad_plugins.compare import app

    app.compare(options.runs, options, options.out, skip_broken=options.skip_broken)
