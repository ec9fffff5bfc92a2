"""`crossgrad compare`: compare runs over seeds, scenes, regimes and budgets."""

from crossgrad_core.commands import announce, command_of
from crossgrad_plugins.compare.options import Command


@command_of(Command)
def compare(options: Command) -> None:
    """Compare runs: what won, by how much, how sure, at what cost.

    Groups runs by what differs in their configurations, pairs them by scene and seed, and writes
    one page, figures for a paper and CSV tables. What does not compare is refused.
    """
    announce()
    from crossgrad_plugins.compare import app

    app.compare(options.runs, options, options.out, skip_broken=options.skip_broken)
