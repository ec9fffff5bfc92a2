"""A run that is interrupted between any two steps goes on to the same bits."""

import pytest
import torch

from crossgrad_core.checkpoint import latest, load, save
from crossgrad_core.checkpoint_folders import Keep
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.assemble import assemble
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.persist import from_checkpoint, to_checkpoint
from crossgrad_core.training.start import first_state

#: Options with which each densifier edits the small scene of the tests.
OPTIONS = {
    "anchor": {"success_threshold": 0, "coarsest": 1},
    "octree": {"success_threshold": 0},
    "mcmc": {"growth": 0.5, "noise": 1e20, "dead_opacity": 0.4},
    "dc4gs": {"split_scale": 1e-3, "split_threshold": 1e-6, "grad_threshold": 1e-6},
    "revising": {"growth_budget": 0.1, "error_threshold": 0.01, "views": 3},
}
#: Backbones that they need, with anchors whose neighbouring cells are free.
BACKBONES = {
    "anchor": {"name": "scaffold", "voxel_size": 1e-5},
    "octree": {"name": "octree", "middle_cell": 1e-5},
}


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("stop", [3, 4])
def test_a_checkpoint_changes_nothing(tmp_path, name, stop):
    config = RunConfig(
        steps=10,
        densify_from=1,
        densify_until=9,
        densify_every=2,
        densifier=ComponentChoice(name=name, **OPTIONS[name]),
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
    edited = 0
    for _ in range(7 - stop):
        edited += any(timed_step(setup, second).counts.values())
    assert edited
    for block, tensor in whole.parameters.items():
        assert torch.equal(tensor, second.parameters[block]), block
    for block, moment in whole.adam.exp_avg.items():
        assert torch.equal(moment, second.adam.exp_avg[block]), block
