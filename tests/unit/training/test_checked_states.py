"""Only states that were looked at are kept, shown or gone back to."""

import signal
from dataclasses import replace
from functools import cache

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Edit, Rows
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import DensifyResult
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import CHECK_EVERY, Stopper, train
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import TrainingFailedError

STEPS = 18


class Poison:
    """Makes a parameter NaN at the end of one step, once.

    The colour of a Gaussian that is not drawn: neither loss nor gradient tells.
    """

    def __init__(self, step):
        self.step = step

    @hookimpl
    def crossgrad_after_step(self, context):
        if context.step != self.step:
            return None
        self.step = None
        opacities = context.parameters["opacities"].detach().clone()
        opacities[0] = -30.0
        colors = context.parameters["f_dc"].detach().clone()
        colors[0] = float("nan")
        return DensifyResult(Edit(values={"opacities": Rows(opacities), "f_dc": Rows(colors)}))


class Watching:
    """A sink that keeps which states it was shown; asks a run to stop after a step."""

    def __init__(self, stops_after=None):
        self.shown, self.rewound = [], []
        self.stopper, self._stops_after = Stopper(), stops_after

    def evaluate(self, setup, state):
        self.shown.append(("evaluated", state.step, is_finite(state)))

    def save(self, setup, state):
        self.shown.append(("saved", state.step, is_finite(state)))

    def rewind(self, setup, step):
        self.rewound.append(step)

    @hookimpl
    def crossgrad_step_end(self, record):
        # After the look at this step.
        if record.step == self._stops_after:
            self.stopper.signal = signal.SIGINT


def is_finite(state):
    return all(bool(t.isfinite().all()) for t in state.parameters.values())


@pytest.fixture(autouse=True)
def _one_thread(keeps_threads):
    configure_threads(1)


@cache
def assembled(**settings):
    # No edit removes what is poisoned.
    never = {"save_every": 1000, "eval_every": 1000, "schedule_unit": "steps"}
    config = RunConfig.model_validate({"steps": STEPS, **never, **settings})
    return assemble(config, sample_scene(), "none")


def watched(poison, sink, **settings):
    setup = assembled(**settings)
    plugins = {**setup.selection.components, "poison": poison, "sink": sink}
    return replace(setup, manager=make_manager(plugins), plugins=plugins)


def trained(setup, state, sink, pauses=()):
    """Trains as a run does, paused after some steps to think about its length."""
    asked = lambda state: state.step in pauses  # noqa: E731
    while (ended := train(setup, state, sink, sink.stopper, asked)) == "paused":
        sink.shown.append(("paused", state.step, is_finite(state)))
    return ended


@pytest.mark.sampled(2)
@pytest.mark.parametrize("step", [3, 7, 12, STEPS])
@pytest.mark.parametrize(
    ("kept", "settings"),
    [
        ("paused", {}),
        ("saved", {"save_every": 1}),
        ("saved", {"save_every": 3}),
        ("evaluated", {"eval_every": 1}),
        ("evaluated", {"eval_every": 4}),
    ],
)
def test_checkpoints_and_results_are_finite(kept, settings, step):
    sink = Watching()
    setup = watched(Poison(step), sink, **settings)
    state = first_state(setup)
    pauses = range(1, STEPS) if kept == "paused" else ()
    assert trained(setup, state, sink, pauses) == "finished"
    assert state.step == STEPS and state.rewinds == 1 and is_finite(state)
    assert {what for what, _, _ in sink.shown} == {kept}
    assert all(finite for _, _, finite in sink.shown)
    assert len(sink.rewound) == 1 and sink.rewound[0] < step


def test_a_pause_right_after_a_non_finite_step_rewinds_to_the_previous_state():
    step = CHECK_EVERY + 3
    sink = Watching()
    setup = watched(Poison(step), sink)
    state = first_state(setup)
    assert trained(setup, state, sink, pauses={5, step}) == "finished"
    assert sink.rewound == [5]
    assert sink.shown == [("paused", 5, True), ("paused", step, True)]


def test_a_signal_after_a_check_leaves_a_valid_state():
    sink = Watching(stops_after=7)
    setup = watched(Poison(7), sink)
    state = first_state(setup)
    assert trained(setup, state, sink) == "stopped"
    assert sink.rewound == [0]
    assert state.step == 0 and is_finite(state)


def test_too_many_dropped_gradients_leave_a_valid_state():
    sink = Watching()
    setup = watched(Poison(7), sink, max_nonfinite_blocks=1)
    state = first_state(setup)
    state.counters.dropped = 1
    with pytest.raises(TrainingFailedError, match="dropped"):
        train(setup, state, sink, sink.stopper)
    assert state.step == 1 and is_finite(state)
    state = first_state(setup)
    drops_in = {7: 1}
    setup.manager.register(Dropping(state, drops_in), name="dropping")
    with pytest.raises(TrainingFailedError, match="dropped"):
        train(setup, state, sink, sink.stopper)
    assert state.step == 0 and is_finite(state)


class Dropping:
    """Counts dropped gradients in given steps."""

    def __init__(self, state, drops_in):
        self.state, self.drops_in = state, drops_in

    @hookimpl
    def crossgrad_after_step(self, context):
        self.state.counters.dropped += self.drops_in.get(context.step, 0)


@pytest.mark.parametrize("part", ["parameters", "exp_avg", "exp_avg_sq"])
def test_a_run_with_a_non_finite_state_is_not_continued(part):
    sink = Watching()
    setup = watched(Poison(None), sink)
    state = first_state(setup)
    trained(replace(setup, config=setup.config.model_copy(update={"stop_after": 4})), state, sink)
    resumed = from_checkpoint(setup, to_checkpoint(state))
    tensors = resumed.parameters if part == "parameters" else getattr(resumed.adam, part)
    tensors["scales"].data[3, 1] = torch.inf
    with pytest.raises(TrainingFailedError) as caught:
        train(setup, resumed, sink, sink.stopper)
    assert "scales is not finite in the state of step 4" in str(caught.value)
    assert "remove checkpoints/step-000004" in str(caught.value)
    assert resumed.step == 4 and sink.rewound == []


def test_a_non_finite_initial_state_is_reported_at_once():
    sink = Watching()
    setup = watched(Poison(None), sink)
    state = first_state(setup)
    state.parameters["means"].data[0, 0] = torch.nan
    with pytest.raises(TrainingFailedError, match=r"means is not finite in the state of step 0"):
        train(setup, state, sink, sink.stopper)
