"""A run that is interrupted between any two steps goes on to the same bits."""

from dataclasses import replace

import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import Keep, latest, load, save
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

#: Options with which each densifier edits the small scene of the tests.
OPTIONS = {
    "adc": {"grad_threshold": 1e-6, "split_scale": 1e-3},
    "absgrad": {"grad_threshold": 1e-6, "abs_threshold": 1e-6, "split_scale": 1e-3},
    "pixel": {"grad_threshold": 1e-6, "split_scale": 1e-3},
    "anchor": {"success_threshold": 0, "coarsest": 1},
    "octree": {"success_threshold": 0},
    "mcmc": {"growth": 0.5, "noise": 1e20, "dead_opacity": 0.4},
    "dc4gs": {"split_scale": 1e-3, "split_threshold": 1e-6, "grad_threshold": 1e-6},
    "revising": {"growth_budget": 0.1, "error_threshold": 0.01, "views": 3},
    "multiview": {"importance": 0, "grad_threshold": 1e-6, "abs_threshold": 1e-6},
    "multiview running": {
        "count": "running",
        "share": 0.5,
        "regimes": True,
        "importance": 0,
        "grad_threshold": 1e-6,
        "abs_threshold": 1e-6,
    },
    "multiview-gate": {
        "count": "running",
        "share": 0.5,
        "importance": 0,
        "of": {"name": "anchor", "success_threshold": 0, "coarsest": 1},
    },
}
#: Backbones that they need, with anchors whose neighbouring cells are free.
BACKBONES = {
    "anchor": {"name": "scaffold", "voxel_size": 1e-5},
    "octree": {"name": "octree", "middle_cell": 1e-5},
    "multiview-gate": {"name": "scaffold", "voxel_size": 1e-5},
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("stop", [3, 4])
def test_resuming_from_a_checkpoint_changes_no_bit(tmp_path, name, stop, edits_in):
    config = RunConfig(
        steps=10,
        initializer=ComponentChoice(name="points"),
        schedule_unit="steps",
        densify_from=1,
        densify_until=9,
        densify_every=2,
        densifier=ComponentChoice(name=name.split()[0], **OPTIONS[name]),
        backbone=ComponentChoice(**BACKBONES.get(name, {"name": "vanilla"})),
    )
    setup = assemble(config, sample_scene(), "none")
    whole = first_state(setup)
    for _ in range(7):
        timed_step(setup, whole)
    first = first_state(setup)
    for _ in range(stop):
        timed_step(setup, first)
    save(tmp_path, to_checkpoint(first), Keep(every=None))
    second = from_checkpoint(setup, load(latest(tmp_path)))
    assert edits_in([timed_step(setup, second) for _ in range(7 - stop)]) > 0
    assert_same(whole.parameters, second.parameters)
    assert_same(whole.adam.exp_avg, second.adam.exp_avg)
    assert_same(whole.adam.exp_avg_sq, second.adam.exp_avg_sq)
    assert whole.adam.steps == second.adam.steps
    assert whole.states.keys() == second.states.keys()
    for plugin, state in whole.states.items():
        assert state.values == second.states[plugin].values
        assert_same(state.tensors, second.states[plugin].tensors)
        assert_same(state.per_primitive, second.states[plugin].per_primitive)


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def test_plugin_states_follow_the_run_to_its_device(tmp_path):
    """Use the device `meta`, because it exists on every machine."""
    config = RunConfig(steps=10, schedule_unit="steps", densify_from=1, densify_until=9)
    setup = assemble(config, sample_scene(), "none")
    state = first_state(setup)
    timed_step(setup, state)
    save(tmp_path, to_checkpoint(state), Keep(every=None))
    moved = from_checkpoint(replace(setup, device=torch.device("meta")), load(latest(tmp_path)))
    held = [*moved.parameters.values(), *moved.adam.exp_avg.values()]
    statistics = [t for each in moved.states.values() for t in each.per_primitive.values()]
    assert statistics and all(tensor.device.type == "meta" for tensor in [*held, *statistics])
