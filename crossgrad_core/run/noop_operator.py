"""A note where the operator that was asked for has nothing to do."""

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.training.setup import Setup


def idle_note(setup: Setup) -> tuple[str, ...]:
    """Says that an operator leaves the gradient of a single view as it is, and the way out.

    The default operator is left alone: a sum of one gradient is expected to be no more than that.
    """
    selection = setup.selection
    name, views = selection.names["operator"], selection.views_per_step
    default: ComponentChoice = RunConfig.model_fields["operator"].default
    if name == default.name or not selection.operator.is_identity(views):
        return ()
    sampler = selection.names["sampler"]
    more = next((k for k in (2, 3) if selection.sampler.view_counts.admits(k)), None)
    way_out = f"--views {more}" if more else f"a sampler other than {sampler} as it is set"
    return (
        f"operator {name} does nothing at K = {views}: a step has one gradient, which it leaves as "
        f"it is; {way_out} gives it more",
    )
