"""Density control does not depend on the number of threads."""

import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

BACKBONES = {
    "anchor": {"name": "scaffold", "voxel_size": 1e-4},
    "octree": {"name": "octree", "middle_cell": 1e-3},
}
OPTIONS = {
    "anchor": {"success_threshold": 0, "coarsest": 1},
    "octree": {"success_threshold": 0},
    "revising": {"error_threshold": 0.01, "views": 3},
    "multiview": {"count": "running", "share": 1, "importance": 0, "grad_threshold": 1e-9},
    "multiview-gate": {"views": 3, "importance": 0},
}


pytestmark = pytest.mark.usefixtures("keeps_threads")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", entries("densifiers"))
def test_training_gives_the_same_bits_on_any_number_of_threads(name, large_scene, edits_in):
    config = RunConfig(
        steps=9,
        schedule_unit="steps",
        densify_from=1,
        densify_until=9,
        densify_every=2,
        reset_every=4,
        sh_from=3,
        densifier=ComponentChoice(name=name, **OPTIONS.get(name, {})),
        backbone=ComponentChoice(**BACKBONES.get(name, {"name": "vanilla"})),
    )
    setup = assemble(config, large_scene, "none")
    states = []
    for threads in (1, 2):
        configure_threads(threads)
        state = first_state(setup)
        records = [timed_step(setup, state) for _ in range(5)]
        states.append(state)
    one, two = states
    assert (edits_in(records) > 0) == (name != "none")
    assert one.primitives(setup) > 2**15
    for tensor, values in one.parameters.items():
        assert torch.equal(values, two.parameters[tensor]), tensor
    for plugin, state in one.states.items():
        for statistic, values in state.per_primitive.items():
            assert torch.equal(values, two.states[plugin].per_primitive[statistic]), statistic
