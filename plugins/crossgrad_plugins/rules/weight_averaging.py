"""The mean of the last parameters, used for evaluation and export (docs/steady-ends.md)."""

from collections.abc import Iterable, Mapping
from typing import ClassVar, Final

from torch import Tensor

from crossgrad_core.plugin import (
    EMPTY_STATE,
    AfterStepContext,
    Answer,
    Block,
    Field,
    PluginState,
    Rule,
    hookimpl,
)

#: Name of the rule and of its stored state.
NAME: Final = "weight-averaging"
_COUNT: Final = "count"
#: Maximum number of steps whose parameters are averaged. Parameters of neighbouring steps hardly
#: differ. The sum of 100 float32 numbers has a relative rounding error of about one millionth.
SAMPLES: Final = 100
#: Number of decimals to which a step number is rounded. Further decimals contain only rounding
#: errors.
_DIGITS: Final = 6


class WeightAveraging(Rule):
    """Averages the parameters over the last share of the steps."""

    copies: ClassVar[int] = 3
    share: float = Field(
        0.2,
        gt=0,
        le=1,
        description="share of the steps, at the end, over which weights are averaged",
    )

    @hookimpl
    def crossgrad_step_done(self, context: AfterStepContext) -> Answer | None:
        """Add the parameters to the sums if this step is one of the averaged steps.

        The sums start again if the number or order of primitives changed, or if parameters were
        overwritten.
        """
        held, total = context.state(NAME), context.schedule.total
        # Round before the conversion. A tenth of ten steps is one step, but floating-point
        # arithmetic gives a slightly different value.
        before = int(round((1.0 - self.share) * total, _DIGITS))
        # If the run was extended, drop the average that was computed before the extension.
        left_out = context.step <= before
        state = EMPTY_STATE if context.edited or left_out else held
        if not left_out and (total - context.step) % -(-(total - before) // SAMPLES) == 0:
            state = _added(state, context.backbone.trained_blocks(), context.parameters)
        return None if state is held else Answer().with_state(NAME, state)

    @hookimpl
    def crossgrad_eval_parameters(
        self, states: Mapping[str, PluginState]
    ) -> Mapping[str, Tensor] | None:
        """Return the mean parameters, or None if no step has been averaged."""
        held = states.get(NAME, EMPTY_STATE)
        count = held.values.get(_COUNT)
        if not isinstance(count, int):
            return None
        sums = {**held.tensors, **held.per_primitive}
        return {name: total / count for name, total in sums.items()}


def _added(
    state: PluginState, blocks: Iterable[Block], parameters: Mapping[str, Tensor]
) -> PluginState:
    """Return the state after the parameters were added to its sums.

    The sums are bitwise equal for any number of threads. The division by the number of steps
    happens when the means are used.
    """
    previous = {**state.tensors, **state.per_primitive}
    sums: tuple[dict[str, Tensor], dict[str, Tensor]] = ({}, {})
    for block in blocks:
        for name in block.tensors:
            value = parameters[name].detach()
            sums[block.per_primitive][name] = previous[name] + value if previous else value.clone()
    count = state.values.get(_COUNT, 0)
    return PluginState({_COUNT: int(str(count)) + 1}, *sums)
