"""How a run comes to rest: rates that fade at its end, and the average of its last parameters.

The rates of opacity, scale and colour are constant as published, so that the picture still moves
at the end of a run as it did before. Either of the two takes that away; both are options.
"""

from collections.abc import Mapping
from typing import Final

from torch import Tensor

from crossgrad_core.contract.blocks import (
    Edit,
    LearningRate,
    Parameters,
    PluginState,
    apply_to_parameters,
)
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: The name among the states of plugins.
STATE: Final = "average"
_COUNT: Final = "count"
#: States that an average is taken over, at most: those of neighbouring steps hardly differ, and
#: sums of so few float32 numbers round by a millionth.
SAMPLES: Final = 100
#: Decimals of a number of steps that are no rounding.
_DIGITS: Final = 6


def tail_lr_factor(setup: Setup, rate: LearningRate, step: int) -> float:
    """What a rate is multiplied by in a step: from 1 log-linearly to `lr_tail_factor`.

    Rates that decay by themselves do so as published.
    """
    total = setup.schedule.total
    step, start = min(step, total), (1.0 - setup.numbers.lr_tail) * total
    if rate.decays or step <= start:
        return 1.0
    return float(setup.config.lr_tail_factor ** ((step - start) / (total - start)))


def update_average(setup: Setup, state: TrainState) -> None:
    """Adds the parameters after a complete step to the average, where they are due."""
    share = setup.config.weight_averaging
    if share == 0.0:
        return
    total = setup.schedule.total
    # A tenth of ten steps is one, though not in binary numbers.
    before = int(round((1.0 - share) * total, _DIGITS))
    if state.step <= before:
        restart(state)  # The run has become longer.
        return
    every = -(-(total - before) // SAMPLES)
    if (total - state.step) % every == 0:
        _add(setup, state)


def _add(setup: Setup, state: TrainState) -> None:
    held = state.states.get(STATE)
    count = 0 if held is None else _count(held)
    sums = {}
    for block in setup.trained_blocks:
        for name in block.tensors:
            value = state.parameters[name].detach()
            # Sums alone have the same bits whatever the number of threads; means are taken late.
            sums[name] = value.clone() if held is None else held.tensors[name] + value
    state.commit({STATE: PluginState({_COUNT: count + 1}, sums)})


def restart(state: TrainState) -> None:
    """Forgets the average: the primitives are others now, or their values were overwritten."""
    state.states.pop(STATE, None)


def with_rows(setup: Setup, state: TrainState, average: PluginState, rows: Tensor) -> PluginState:
    """The average of fewer primitives.

    Args:
        setup: The run.
        state: Its state.
        average: The average of all of its primitives.
        rows: [M] int64, the primitives that are kept.
    """
    sums = {**state.tensors, **average.tensors}
    kept = apply_to_parameters(Edit(rows), setup.blocks, sums)
    return PluginState(average.values, {name: kept[name] for name in average.tensors})


def eval_parameters(state: TrainState) -> Parameters:
    """The parameters that evaluations and exports show: the average, where there is one."""
    held = state.states.get(STATE)
    if held is None:
        return state.parameters
    count = _count(held)
    return {**state.parameters, **{name: sums / count for name, sums in held.tensors.items()}}


def fits(state: PluginState, parameters: Mapping[str, Tensor]) -> bool:
    """Whether a stored average can be one of these parameters."""
    count = state.values.get(_COUNT)
    if not isinstance(count, int) or count < 1:
        return False
    return all(
        name in parameters and sums.shape == parameters[name].shape
        for name, sums in state.tensors.items()
    )


def _count(state: PluginState) -> int:
    count = state.values[_COUNT]
    if not isinstance(count, int):
        message = f"the average counts {count!r} states"
        raise TypeError(message)
    return count
