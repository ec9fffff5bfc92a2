"""Which views density control gets the statistics of."""

from collections.abc import Sequence
from dataclasses import replace

from crossgrad_core.contract.contexts import ViewRecord, ViewSample
from crossgrad_core.training.relabel import groups_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import observe_view, scales_of

#: Name of the stream that all random numbers of further views come from.
STREAM = "density"


def observed_views(
    setup: Setup, state: TrainState, records: Sequence[ViewRecord]
) -> tuple[ViewRecord, ...]:
    """Of the views of a step those that density control gets, and a further one where it is due.

    Raises:
        NonFiniteError: The loss of the further view is not finite.
    """
    if setup.config.densify_views == "one":
        # Each place of a draw in turn, as samplers may always put the same group first.
        return (records[state.step % len(records)],)
    wanted = setup.schedule.grows and setup.schedule.collects(state.step)
    if setup.config.densify_views != "extra" or not wanted:
        return tuple(records)
    # Whatever is drawn for the further view, its background and what plugins draw included.
    streams, states = dict.fromkeys(state.rngs, state.rngs[STREAM]), dict(state.states)
    state = replace(state, rngs=streams, states=states)
    index = int(state.rngs[STREAM].integers(len(setup.train_views)))
    groups = groups_of(setup, state)
    draw = ViewSample((index,), None if groups is None else (groups[index],))
    return (*records, observe_view(setup, state, draw, scales_of(setup, state, draw)[0]))
