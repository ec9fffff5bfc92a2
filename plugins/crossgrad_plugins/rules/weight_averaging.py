"""The average of the last parameters, which evaluations and exports show (docs/steady-ends.md)."""

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

#: The name of the rule, and of its state.
NAME: Final = "weight-averaging"
_COUNT: Final = "count"
#: Most states that an average is taken over. Neighbouring states hardly differ, and sums of so few
#: float32 numbers round by a millionth.
SAMPLES: Final = 100
#: Decimals of a number of steps that are no rounding.
_DIGITS: Final = 6


class WeightAveraging(Rule):
    """Shows the average of the parameters of the last share of the steps."""

    copies: ClassVar[int] = 3
    share: float = Field(
        0.2, gt=0, le=1, description="share of the steps, the last ones, that are averaged"
    )

    @hookimpl
    def crossgrad_step_done(self, context: AfterStepContext) -> Answer | None:
        """Add the parameters to the sums in the steps that are averaged.

        The sums start again if the primitives are others now, or if their values were overwritten.
        """
        held, total = context.state(NAME), context.schedule.total
        # A tenth of ten steps is one, though not in binary numbers.
        before = int(round((1.0 - self.share) * total, _DIGITS))
        left_out = context.step <= before  # The run may have become longer.
        state = EMPTY_STATE if context.edited or left_out else held
        if not left_out and (total - context.step) % -(-(total - before) // SAMPLES) == 0:
            state = _added(state, context.backbone.trained_blocks(), context.parameters)
        return None if state is held else Answer().with_state(NAME, state)

    @hookimpl
    def crossgrad_eval_parameters(
        self, states: Mapping[str, PluginState]
    ) -> Mapping[str, Tensor] | None:
        """Return the means, if there are any yet."""
        held = states.get(NAME, EMPTY_STATE)
        count = held.values.get(_COUNT)
        if not isinstance(count, int):
            return None
        sums = {**held.tensors, **held.per_primitive}
        return {name: each / count for name, each in sums.items()}


def _added(
    state: PluginState, blocks: Iterable[Block], parameters: Mapping[str, Tensor]
) -> PluginState:
    """Return the state with the parameters added to its sums.

    Sums alone have the same bits on any number of threads; means are taken when they are shown.
    """
    known = {**state.tensors, **state.per_primitive}
    sums: tuple[dict[str, Tensor], dict[str, Tensor]] = ({}, {})
    for block in blocks:
        for name in block.tensors:
            value = parameters[name].detach()
            sums[block.per_primitive][name] = known[name] + value if known else value.clone()
    count = state.values.get(_COUNT, 0)
    return PluginState({_COUNT: int(str(count)) + 1}, *sums)
