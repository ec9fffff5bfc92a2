"""Which views density control gets the statistics of."""

from collections.abc import Sequence

from crossgrad_core.contract.contexts import Draw, ViewRecord
from crossgrad_core.training.regrouping import groups_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import is_observed, observe_view

#: Name of the stream of random numbers that further views are drawn from.
STREAM = "density"


def observed_views(
    setup: Setup, state: TrainState, records: Sequence[ViewRecord]
) -> tuple[ViewRecord, ...]:
    """Of the views of a step those that density control gets, and a further one where it is due.

    Raises:
        NonFiniteError: The loss of the further view is not finite.
    """
    views = len(records)
    own = (record for slot, record in enumerate(records) if is_observed(setup, state, slot, views))
    if setup.config.density_views != "extra" or not setup.schedule.collects(state.step):
        return tuple(own)
    index = int(state.rngs[STREAM].integers(len(setup.train_views)))
    groups = groups_of(setup, state)
    draw = Draw((index,), None if groups is None else (groups[index],))
    return (*own, observe_view(setup, state, draw, records[0].scale))
