"""A sampler that is stopped and resumed goes on as if nothing had happened."""

import json

import numpy as np
import pytest

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import SamplerRun, posed_scene, posed_view

TWO = ("near",) * 4 + ("far",) * 7
THREE = ("near",) * 3 + ("middle",) * 4 + ("far",) * 4
CASES = {
    "active": ({}, TWO, 2),
    "anchors-30": ({}, THREE, 2),
    "epoch": ({}, None, 3),
    "fps": ({}, None, 3),
    "horizon": ({}, TWO, 2),
    "near-far": ({"order": "epoch"}, TWO, 4),
    "random": ({"distinct": True}, None, 2),
    "random-split": ({"order": "epoch"}, None, 2),
    "three-way": ({"order": "epoch"}, THREE, 3),
}


def start(name):
    options, groups, k = CASES[name]
    points = np.random.default_rng(3).normal(size=(11, 3))
    scene = posed_scene([posed_view(p, f"{i}.png") for i, p in enumerate(points)])
    losses = [0.1 * i for i in range(11)]
    return SamplerRun(build("samplers", name, options), scene, groups, k, losses=losses)


@pytest.mark.sampled(10)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("stop", [1, 7, 20])
def test_a_resumed_sampler_continues_with_the_same_views(name, stop):
    straight = start(name)
    expected = [draw.views for draw in straight.draws(stop + 30)][stop:]
    first = start(name)
    list(first.draws(stop))
    resumed = start(name)
    # What a checkpoint holds: JSON values, the generator's state, the step and its record.
    assert not first.state.tensors
    resumed.state = PluginState(json.loads(json.dumps(dict(first.state.values))))
    resumed.rng.bit_generator.state = json.loads(json.dumps(first.rng.bit_generator.state))
    resumed.step, resumed.last = first.step, first.last
    assert [draw.views for draw in resumed.draws(30)] == expected


@pytest.mark.parametrize("name", CASES)
def test_sampling_does_not_change_the_given_state(name):
    run = start(name)
    list(run.draws(5))
    before = json.dumps(dict(run.state.values))
    state = run.state
    list(run.draws(15))
    assert json.dumps(dict(state.values)) == before


@pytest.mark.parametrize("name", CASES)
def test_only_equal_seeds_give_equal_views(name):
    def views(seed):
        run = start(name)
        run.rng = np.random.default_rng(seed)
        return [draw.views for draw in run.draws(25)]

    assert views(5) == views(5)
    assert views(5) != views(6)
