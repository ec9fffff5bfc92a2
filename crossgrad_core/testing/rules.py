"""Contract checks for rules, which train short runs on the sample scene."""

from copy import deepcopy

import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.slots.rule import Rule
from crossgrad_core.numerics.threads import on_one_thread
from crossgrad_core.registry.entries import name_of
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    global_randomness_untouched,
    require,
    revived,
)
from crossgrad_core.testing.support.short_runs import (
    require_repeated,
    require_sound,
    setup_of,
    train,
)
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.step import final_edits

#: `_STEPS`: number of steps of a run. `_STOP`: the step after which a run is stopped. Weight
#: averages and learning-rate tails begin before the step `_STOP`.
_STEPS, _STOP = 8, 6


def trains_soundly(make: Make[Rule]) -> None:
    """A run with the rule trains finite parameters. A second run gives equal parameters."""
    setup = _setup(make)
    with on_one_thread(), global_randomness_untouched():
        run = train(setup, _STEPS)
        require_sound(run)
        require_repeated(run, train(setup, _STEPS))


def goes_on_from_a_checkpoint(make: Make[Rule]) -> None:
    """A run that was stopped and resumed ends with the bits of an uninterrupted run."""
    setup = _setup(make)
    with on_one_thread():
        state = first_state(setup)
        _steps(setup, state, _STOP)
        again = from_checkpoint(setup, deepcopy(to_checkpoint(state)))
        again.states = {name: revived(held) for name, held in again.states.items()}
        for run_state in (state, again):
            _steps(setup, run_state, _STEPS)
            for _ in final_edits(setup, run_state):
                require(run_state.primitives(setup), "no Gaussian is left at the end of a run")
    for name, tensor in state.parameters.items():
        same = torch.equal(tensor, again.parameters[name])
        require(same, f"a resumed run differs in {name}: keep all state of a rule in its state")


def says_why_it_would_do_nothing(make: Make[Rule]) -> None:
    """`unused` returns the reason why the rule would have no effect, or an empty text."""
    setup = _setup(make)
    reason = make().unused(setup.backbone, setup.scene)
    require(isinstance(reason, str), f"unused() returns {reason!r}, not a string")


def _setup(make: Make[Rule]) -> Setup:
    rule = make()
    return setup_of(RunConfig(steps=_STEPS, device="cpu")).with_rules({name_of(rule): rule})


def _steps(setup: Setup, state: TrainState, until: int) -> None:
    while state.step < until:
        timed_step(setup, state)


RULE_CHECKS: tuple[Check[Rule], ...] = (
    *COMPONENT_CHECKS,
    trains_soundly,
    goes_on_from_a_checkpoint,
    says_why_it_would_do_nothing,
)
