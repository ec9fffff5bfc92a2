"""Whatever is raised in a step, the state is a good one that goes on to the same bits."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.hooks import HookSpecs
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.load_run import to_checkpoint
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import state as states
from crossgrad_core.training.loop import Stopper, train
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import TrainState

STEPS, SAVE_EVERY, FAILS_IN = 20, 5, 13
#: Edits before and after the step that fails.
CONFIG = RunConfig.model_validate(
    {
        "steps": STEPS, "save_every": SAVE_EVERY, "eval_every": 6, "background": "random",
        "densify_from": 3, "densify_until": 18, "densify_every": 3, "schedule_unit": "steps",
        "densifier": {"name": "adc", "grad_threshold": 1e-6, "split_scale": 1e-3},
    }
)  # fmt: skip

SEAMS = ("crossgrad_sample_views", "crossgrad_aggregate_gradients", "crossgrad_densify")


class BrokenError(Exception):
    """What the plugins of these tests raise."""


class Trap:
    """Raises when it is sprung in one step."""

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def spring(self, step: int) -> None:
        if step == FAILS_IN:
            raise self._error


@hookimpl(wrapper=True)
def before(self, context):
    self.spring(context.step)
    return (yield)


@hookimpl(wrapper=True)
def after(self, context):
    answer = yield
    self.spring(context.step)
    return answer


@hookimpl
def of_context(self, context):
    self.spring(context.step)


@hookimpl
def of_rate(self, step):
    self.spring(step)


@hookimpl
def of_record(self, record):
    self.spring(record.step)


@hookimpl
def of_model(self, model):
    self.spring(model.phase.step)


#: Before parameters change only the step under way is lost. While they change, training returns to
#: the copy that was made with the last checkpoint. Afterwards nothing is lost.
BEFORE, WHILE, AFTERWARDS = FAILS_IN - 1, FAILS_IN - FAILS_IN % SAVE_EVERY, FAILS_IN
HOOKS = [
    ("sample_views", before, BEFORE),
    ("sample_views", after, BEFORE),
    ("choose_scales", before, BEFORE),
    ("choose_scales", after, BEFORE),
    ("view_gaussians", of_context, BEFORE),
    ("pixel_weights", of_context, BEFORE),
    ("regularize", of_context, BEFORE),
    ("aggregate_gradients", before, BEFORE),
    ("aggregate_gradients", after, BEFORE),
    ("rate_factor", of_rate, WHILE),
    ("after_optimizer", of_context, WHILE),
    ("densify", before, WHILE),
    ("densify", after, WHILE),
    ("after_step", of_context, WHILE),
    ("step_done", of_context, WHILE),
    ("step_end", of_record, AFTERWARDS),
    ("model_ready", of_model, AFTERWARDS),
]


def trap(hook: str, method: object, error: BaseException) -> Trap:
    """A plugin with one hook that raises in one step."""
    return type("Trapped", (Trap,), {f"crossgrad_{hook}": method})(error)


class Results:
    """A sink that remembers when it was asked; may raise."""

    def __init__(self, error: Exception | None = None, when: str = "") -> None:
        self.saved: list[int] = []
        self._error, self._when = error, when

    def evaluate(self, setup, state):
        self._spring("evaluate", state.step)

    def save(self, setup, state):
        self._spring("save", state.step)
        self.saved.append(state.step)

    def rewind(self, setup, step):
        raise AssertionError

    def _spring(self, when, step):
        if self._error is not None and when == self._when and step > SAVE_EVERY:
            raise self._error


class Spoil:
    """Makes a colour NaN after a step."""

    def __init__(self, state, step: int) -> None:
        self._state, self._step = state, step

    @hookimpl
    def crossgrad_model_ready(self, model):
        if model.phase.step == self._step:
            with torch.no_grad():
                self._state.parameters["f_rest"][0] = float("nan")


def assembled(*plugins):
    setup = assemble(CONFIG, sample_scene(), "none")
    named = {**setup.plugins, **{f"trap{i}": plugin for i, plugin in enumerate(plugins)}}
    return replace(setup, manager=make_manager(named), plugins=named)


@cache
def trained_until(step: int) -> TrainState:
    """The state of a run that nothing disturbs, after that step."""
    setup = assembled()
    stopped = replace(setup, config=setup.config.model_copy(update={"stop_after": step}))
    state = first_state(stopped)
    train(stopped, state, Results(), Stopper())
    return state


def assert_same(state, wanted) -> None:
    found, other = to_checkpoint(state), to_checkpoint(wanted)
    for kind in ("parameters", "exp_avg", "exp_avg_sq"):
        ours, theirs = getattr(found, kind), getattr(other, kind)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[name], theirs[name]) for name in ours), kind
    assert (found.step, found.adam_steps) == (other.step, other.adam_steps)
    assert found.generators == other.generators
    assert state.counters == wanted.counters
    assert state.last.losses == wanted.last.losses
    for name, plugin in found.plugins.items():
        for key, tensor in {**plugin.tensors, **plugin.per_primitive}.items():
            theirs = {**other.plugins[name].tensors, **other.plugins[name].per_primitive}
            assert torch.equal(tensor, theirs[key]), (name, key)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("hook", "method", "kept"), HOOKS)
def test_a_plugin_that_raises_leaves_a_valid_state(hook, method, kept):
    setup = assembled(trap(hook, method, BrokenError("sorry")))
    state = first_state(setup)
    with pytest.raises(BrokenError) as told:
        train(setup, state, Results(), Stopper())
    assert told.value.__notes__[-1] == f"in step {FAILS_IN}"
    assert state.step == kept
    assert all(tensor.grad is None for tensor in state.parameters.values())
    assert_same(state, trained_until(kept))


def test_a_run_continued_after_an_error_ends_with_the_same_bits():
    setup = assembled(trap("densify", after, BrokenError()))
    state = first_state(setup)
    with pytest.raises(BrokenError):
        train(setup, state, Results(), Stopper())
    train(assembled(), state, Results(), Stopper())
    assert_same(state, trained_until(STEPS))


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), SystemExit(3), MemoryError(), OSError(28, "full")]
)
def test_any_exception_in_a_hook_rewinds_to_the_last_good_state(error):
    setup = assembled(trap("aggregate_gradients", after, error))
    state = first_state(setup)
    with pytest.raises(type(error)):
        train(setup, state, Results(), Stopper())
    assert_same(state, trained_until(FAILS_IN - 1))


@pytest.mark.parametrize(("when", "kept"), [("evaluate", 6), ("save", 10)])
def test_results_that_cannot_be_written_lose_no_step(when, kept):
    setup = assembled()
    state = first_state(setup)
    with pytest.raises(BrokenError):
        train(setup, state, Results(BrokenError(), when), Stopper())
    assert_same(state, trained_until(kept))


def test_a_state_with_a_non_finite_value_is_discarded():
    setup = assembled(trap("step_end", of_record, BrokenError()))
    state = first_state(setup)
    # Not looked for between the steps 12 and 15.
    setup.manager.register(Spoil(state, FAILS_IN - 1), name="spoil")
    with pytest.raises(BrokenError):
        train(setup, state, Results(), Stopper())
    assert_same(state, trained_until(10))


def test_a_rollback_after_an_edit_without_memory_needs_no_memory(monkeypatch):
    def no_room(*_args, **_kwargs):
        raise torch.OutOfMemoryError("no room")

    def run_out(self, context):
        answer = yield
        if context.step == FAILS_IN:
            monkeypatch.setattr(torch.Tensor, "clone", no_room)
        self.spring(context.step)
        return answer

    spill = hookimpl(wrapper=True)(run_out)
    setup = assembled(trap("densify", spill, torch.OutOfMemoryError("no room for the edit")))
    state = first_state(setup)
    with pytest.raises(torch.OutOfMemoryError, match="for the edit"):
        train(setup, state, Results(), Stopper())
    monkeypatch.undo()
    assert_same(state, trained_until(WHILE))


def test_a_failing_check_does_not_prevent_the_rollback(monkeypatch):
    def lost(_state):
        raise RuntimeError("CUDA error")

    setup = assembled(trap("densify", before, BrokenError()))
    state = first_state(setup)
    monkeypatch.setattr(states, "are_parameters_finite", lost)
    with pytest.raises(BrokenError):
        train(setup, state, Results(), Stopper())
    assert_same(state, trained_until(WHILE))


def test_only_checked_states_are_saved_as_checkpoints():
    """A parameter that no view renders any more is also checked before it is saved."""
    setup = assembled()
    state = first_state(setup)
    results = Results()
    setup.manager.register(Spoil(state, SAVE_EVERY - 1), name="spoil")
    results.rewind = lambda setup, step: None
    with pytest.raises(Exception, match="not finite"):
        train(setup, state, results, Stopper())
    assert results.saved == []


def test_an_error_reported_from_the_background_ends_training_after_the_step():
    stopper = Stopper()
    setup = assembled()
    state = first_state(setup)

    class Finder:
        @hookimpl
        def crossgrad_step_end(self, record):
            if record.step == 7:
                stopper.error = BrokenError("found")

    setup.manager.register(Finder(), name="finder")
    with pytest.raises(BrokenError, match="found"):
        train(setup, state, Results(), stopper)
    assert_same(state, trained_until(7))


def test_the_tests_cover_every_hook_of_a_step():
    outside = {
        *("validate_selection", "run_start", "update_intervals", "eval_parameters", "final_edit"),
        *("evaluation", "length_changed", "between_steps", "log", "run_end"),
    }
    hooks = {name for name in vars(HookSpecs) if name.startswith("crossgrad_")}
    assert hooks == {f"crossgrad_{name}" for name in (*outside, *(hook for hook, *_ in HOOKS))}
