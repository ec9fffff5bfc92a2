"""Runs that start from the Gaussians of a file, and from points in any order of memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.export import export_scene
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_camera, sample_scene
from crossgrad_core.training.budget import with_length
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of some steps with all SH bands, and the file that it wrote."""
    setup = assemble(RunConfig(steps=1000), sample_scene(), "none")
    state = first_state(setup)
    state.step = max(3 * setup.schedule.sh_interval, setup.schedule.sh_wait)
    for _ in range(3):
        timed_step(setup, state)
    path = tmp_path_factory.mktemp("start") / "point_cloud.ply"
    export_scene(setup, state, path)
    return setup, state, path


def decoded(setup, state):
    phase = setup.phase(state.step, training=True)
    return setup.backbone.decode(state.parameters, sample_camera(), phase)


def test_a_run_from_a_ply_starts_with_all_bands_of_the_file(trained):
    setup, state, path = trained
    config = RunConfig.model_validate({"steps": 1000, "data": {"init": str(path)}})
    again = assemble(config, sample_scene(), "none")
    ours, wanted = decoded(again, first_state(again)), decoded(setup, state)
    assert ours.sh_degree == wanted.sh_degree == again.backbone.sh_degree > 0
    assert torch.equal(ours.sh_rest, wanted.sh_rest) and ours.sh_rest.abs().max() > 0
    assert torch.allclose(ours.means, wanted.means, atol=1e-6)
    assert torch.allclose(ours.opacities, wanted.opacities, atol=1e-6)
    assert with_length(again, 10, 2000).schedule.sh_from == 3


def test_the_initial_ply_and_its_sh_degree_are_recorded(trained, monkeypatch):
    path = trained[2]
    monkeypatch.chdir(path.parent)
    config = RunConfig.model_validate({"steps": 1000, "data": {"init": path.name}})
    written = resolved(assemble(config, sample_scene(), "none"))
    assert (written.data.init, written.sh_from) == (str(path.resolve()), 3)


@pytest.mark.parametrize(("asked", "degree"), [(None, 0), (2, 2)])
def test_points_start_with_the_requested_sh_degree(asked, degree):
    setup = assemble(RunConfig(steps=1000, sh_from=asked), sample_scene(), "none")
    assert decoded(setup, first_state(setup)).sh_degree == degree


def test_initial_parameters_are_contiguous_in_memory():
    scene = sample_scene()
    turned = replace(scene, points=np.asfortranarray(scene.points))
    assert not turned.points.flags.c_contiguous
    usual, found = (
        first_state(assemble(RunConfig(steps=1000), each, "none")) for each in (scene, turned)
    )
    for name, tensor in found.tensors.items():
        assert tensor.is_contiguous(), name
        assert torch.equal(tensor, usual.tensors[name]), name
