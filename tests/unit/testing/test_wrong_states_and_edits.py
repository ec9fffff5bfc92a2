"""States that grow for ever, edits that remove nearly all, and views without label or by place."""

from unittest import SkipTest

import numpy as np
import pytest
import torch

from crossgrad_core import plugin as api
from crossgrad_core.registry.entries import load
from crossgrad_core.testing import densifiers, operators, resolutions, samplers
from crossgrad_core.testing.support import aggregation, growth
from crossgrad_core.testing.support.contract import ContractError

NoDensification = load("densifiers", "none")
FullSize = load("resolutions", "full")


def longer(context, state):
    return api.PluginState({"steps": [*state.values.get("steps", []), context.step]})


class Hoards(api.Sampler):
    def sample(self, context, state):
        drawn = context.rng.integers(len(context.scene.train), size=context.views_per_step)
        return api.ViewSample(tuple(map(int, drawn))), longer(context, state)


class Unlabelled(api.Sampler):
    def sample(self, context, state):
        return api.ViewSample((0,) * context.views_per_step), state


class HoardsScales(FullSize):
    def scales(self, context, state):
        return (1.0,) * len(context.draw.views), longer(context, state)


class HoardsEdits(NoDensification):
    def densify(self, context, state):
        return api.NO_EDIT, longer(context, state)


class Adding(api.GramianOperator):
    def transform(self, gramians, context, state, rng):
        return self.weights(context, rng)[:, None, :], state

    def weights(self, context, rng):
        return np.where(context.present, 1.0, 0.0)


class HoardsWeights(Adding):
    def transform(self, gramians, context, state, rng):
        matrices, _ = super().transform(gramians, context, state, rng)
        return matrices, longer(context, state)


class FirstCountsTwice(Adding):
    def weights(self, context, rng):
        weights = super().weights(context, rng)
        weights[:, 0] *= 2.0
        return weights


class AtRandom(Adding):
    """Weights that are drawn are no order."""

    def weights(self, context, rng):
        return super().weights(context, rng) * rng.uniform(0.5, 1.5, context.present.shape)


class LeavesOne(NoDensification):
    def densify(self, context, state):
        if not context.schedule.densifies(context.step):
            return api.NO_EDIT, state
        return api.Edit(source=torch.tensor([0])), state


class RepeatsOne(NoDensification):
    """As many rows as before, all of one primitive."""

    def densify(self, context, state):
        if not context.schedule.densifies(context.step):
            return api.NO_EDIT, state
        source = torch.zeros(len(context.parameters["means"]), dtype=torch.int64)
        return api.Edit(source=source), state


@pytest.mark.parametrize(
    ("check", "make", "words"),
    [
        (samplers.draws_hand_on_the_groups, Unlabelled, "a ViewSample without labels"),
        (samplers.states_stay_bounded, Hoards, "that sample returns grows without limit"),
        (resolutions.states_stay_bounded, HoardsScales, "that scales returns grows without limit"),
        (densifiers.states_stay_bounded, HoardsEdits, "that densify returns grows without limit"),
        (
            aggregation.states_stay_bounded,
            HoardsWeights,
            "that aggregate returns grows without limit",
        ),
        (operators.views_that_are_alike_count_alike, FirstCountsTwice, r"weights \[2.0, 1.0\]"),
        (densifiers.most_primitives_survive, LeavesOne, "keeps 1 of 40 Gaussians"),
        (densifiers.most_primitives_survive, RepeatsOne, "keeps 1 of 40 Gaussians"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_wrong_state_or_edit_is_refused_with_the_right_reason(check, make, words, short_windows):
    with pytest.raises(ContractError, match=words):
        check(make)


def test_randomly_drawn_weights_are_not_compared():
    with pytest.raises(SkipTest, match="random numbers"):
        operators.views_that_are_alike_count_alike(AtRandom)


def test_a_state_that_covers_a_window_of_the_last_steps_counts_as_bounded():
    growth.require_bounded((min(step, 900) for step in range(10_000)), "sample")


def test_a_state_that_grows_for_3000_steps_is_refused():
    with pytest.raises(ContractError, match="1,007 numbers after 1,016 steps and 3,007 after"):
        growth.require_bounded((max(step, 8) - 8 for step in range(10_000)), "sample")


def test_numbers_letters_and_tensor_columns_count_as_the_size_of_a_state():
    state = api.PluginState(
        {"name": "abc", "list": [1, 2]}, {"t": torch.zeros(5)}, {"r": torch.zeros(9, 2)}
    )
    assert growth.size_of(state) == len("name") + 3 + len("list") + 2 + 5 + 2
