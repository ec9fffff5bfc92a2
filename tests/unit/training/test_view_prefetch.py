"""The views of the next steps are foreseen, and nothing of the run is touched by it."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import EMPTY_STATE
from crossgrad_core.contract.contexts import StepRecord, ViewSample
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import WIDTH, sample_scene
from crossgrad_core.training.loop import Prefetcher, timed_step
from crossgrad_core.training.start import first_state

SAMPLERS = ("random", "epoch", "near-far", "fps", "horizon", "random-split", "three-way")


class Told:
    """Stands in for the threads; notes what was expected."""

    useful = True

    def __init__(self):
        self.names = []

    def expect(self, views):
        self.names.append([view.name for view in views])

    def taken_cpu(self):
        return 0.0


def setup_of(sampler, **changes):
    config = RunConfig.model_validate({"steps": 12, "sampler": {"name": sampler}, **changes})
    return replace(assemble(config, sample_scene(), "none"), photos_ahead=Told())


@pytest.mark.sampled(1)
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_the_sampled_views_are_predicted_from_the_first_step_on(sampler):
    setup = setup_of(sampler)
    state, prefetcher = first_state(setup), Prefetcher(setup)
    for _ in range(12):
        prefetcher.update(state)
        expected = list(setup.photos_ahead.names[-1])
        assert len(expected) >= min(8, 12 - state.step)
        drawn = timed_step(setup, state).names
        assert tuple(expected[: len(drawn)]) == drawn
    assert len(setup.photos_ahead.names) == 12


@pytest.mark.sampled(1)
@pytest.mark.parametrize("sampler", [*SAMPLERS, "active"])
def test_prediction_changes_nothing_in_the_run(sampler):
    setup = setup_of(sampler)
    state, prefetcher = first_state(setup), Prefetcher(setup)
    for _ in range(6):
        before = deepcopy((state.states.get("sampler"), state.rngs, state.step))
        prefetcher.update(state)
        streams = {name: rng.bit_generator.state for name, rng in state.rngs.items()}
        assert streams == {name: rng.bit_generator.state for name, rng in before[1].items()}
        assert (state.states.get("sampler"), state.step) == (before[0], before[2])
        timed_step(setup, state)


def test_a_step_with_other_views_restarts_the_prediction():
    setup = setup_of("random")
    state, prefetcher = first_state(setup), Prefetcher(setup)
    prefetcher.update(state)
    timed_step(setup, state)
    state.last = replace(state.last, views=(-1, -1))
    state.rngs["sampler"].random(3)
    prefetcher.update(state)
    expected = setup.photos_ahead.names[-1]
    assert tuple(expected[:2]) == timed_step(setup, state).names


def test_views_given_as_an_array_are_predicted():
    setup = setup_of("random", views_per_step=2)
    sample = setup.sampler.sample

    def as_array(*given):
        draw, state = sample(*given)
        return replace(draw, views=np.array(draw.views)), state

    object.__setattr__(setup.sampler, "sample", as_array)
    state, prefetcher = first_state(setup), Prefetcher(setup)
    for _ in range(3):
        prefetcher.update(state)
        drawn = timed_step(setup, state).names
        assert tuple(setup.photos_ahead.names[-1][:2]) == drawn
    assert len(setup.photos_ahead.names) == 3


@pytest.mark.parametrize("views", [(99,), None])
def test_views_that_do_not_exist_are_not_predicted(views):
    setup = setup_of("random")
    wrong = ViewSample(views)
    object.__setattr__(setup.sampler, "sample", lambda *_: (wrong, EMPTY_STATE))
    Prefetcher(setup).update(first_state(setup))
    assert setup.photos_ahead.names == []


def test_views_of_a_failing_sampler_are_not_predicted():
    setup = setup_of("random")
    state, prefetcher = first_state(setup), Prefetcher(setup)

    def fail(*_):
        raise ValueError

    object.__setattr__(setup.sampler, "sample", fail)
    prefetcher.update(state)
    prefetcher.update(state)
    assert setup.photos_ahead.names == []


@pytest.mark.parametrize(("resolution", "width"), [("octaves", WIDTH // 2), ("strided", WIDTH)])
def test_photos_stored_in_their_source_size_are_not_decoded(resolution, width):
    class OddOnesKept:
        def holds(self, view, camera):
            asked.append(camera.width)
            return view.name in odd

    setup = setup_of("epoch", resolution={"name": resolution})
    setup = replace(setup, scaled_photos=OddOnesKept())
    odd, asked = {view.name for view in setup.train_views[1::2]}, []
    state = first_state(setup)
    state.last = StepRecord(0, (0,), ("",), None, (0.1,), 1, {}, 0.0, scales=(0.5,))
    Prefetcher(setup).update(state)
    assert set(asked) == {width}
    (expected,) = setup.photos_ahead.names
    assert expected and not odd & set(expected)
