"""Somebody else's reader finds in every backbone's PLY what the backbone exports."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gsply import plyread
from gsply.formats import EXPECTED_PROPERTIES_BY_SH_DEGREE

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.registry.entries import offers
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.export import export_scene
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.authoring.matrix.combinations import NEEDED
from crossgrad_plugins.exporters.ply_cloud import SplatCloud

OURS = sorted(e.name for e in offers("backbones") if e.distribution == "crossgrad")
NORMALS = ["nx", "ny", "nz"]


@pytest.fixture(scope="module", params=OURS)
def exported(request, tmp_path_factory):
    """A backbone after two steps with all SH bands, its cloud in input units, and its PLY."""
    scene = replace(sample_scene(), similarity=Similarity(np.array([3.0, -2.0, 1.5]), 0.25))
    choice = {"name": request.param, **NEEDED.get(("backbone", request.param), {})}
    setup = assemble(RunConfig.model_validate({"steps": 1000, "backbone": choice}), scene, "none")
    state = first_state(setup)
    state.step = max(3 * setup.schedule.sh_interval, setup.schedule.sh_wait)
    for _ in range(2):
        timed_step(setup, state)
    path = tmp_path_factory.mktemp(request.param) / "point_cloud.ply"
    count = export_scene(setup, state, path).gaussians
    cameras = [view.camera for view in setup.train_views]
    with torch.no_grad():
        phase = setup.phase(state.step, training=False)
        gaussians = setup.backbone.bake(state.parameters, phase, cameras)
    cloud = SplatCloud.from_gaussians(gaussians).to_input(scene.similarity)
    return setup, state, cloud, count, path


def test_a_ply_has_the_standard_properties_in_order_and_the_right_count(exported):
    *_, count, path = exported
    header = path.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = [line.split()[2] for line in header if line.startswith("property float ")]
    assert len(names) == sum(line.startswith("property ") for line in header)
    standard = EXPECTED_PROPERTIES_BY_SH_DEGREE[3]
    assert names == [*standard[:3], *NORMALS, *standard[3:]]
    assert f"element vertex {count}" in header
    assert len(plyread(path)) == count > 0


def test_a_ply_contains_the_values_of_the_exported_cloud(exported):
    _, _, cloud, count, path = exported
    found = plyread(path)
    assert found.is_scales_ply and found.is_opacities_ply and found.is_sh0_sh
    assert found.get_sh_degree() == 3
    assert len(cloud) == count
    np.testing.assert_array_equal(found.means, cloud.means.astype(np.float32))
    np.testing.assert_array_equal(found.scales, cloud.log_scales)
    np.testing.assert_array_equal(found.quats, cloud.quats)
    np.testing.assert_array_equal(found.opacities, cloud.logit_opacities)
    np.testing.assert_array_equal(found.sh0, cloud.sh_dc)
    np.testing.assert_array_equal(found.shN, cloud.sh_rest)


@pytest.mark.parametrize("exported", ["vanilla"], indirect=True)
def test_a_vanilla_ply_contains_the_parameters_of_the_backbone(exported):
    setup, state, _, _, path = exported
    found = plyread(path)
    parameters = {name: t.detach().double().numpy() for name, t in state.parameters.items()}
    similarity = setup.scene.similarity
    close = {"rtol": 1e-5, "atol": 1e-6}
    means = parameters["means"] / similarity.scale + np.array([3.0, -2.0, 1.5])
    np.testing.assert_allclose(found.means, means, **close)
    scales = parameters["scales"] - np.log(similarity.scale)
    np.testing.assert_allclose(found.scales, scales, **close)
    np.testing.assert_allclose(found.opacities, parameters["opacities"].ravel(), **close)
    np.testing.assert_allclose(found.sh0, parameters["f_dc"].reshape(-1, 3), **close)
    bands = parameters["f_rest"]
    assert np.abs(bands).max() > 0
    np.testing.assert_allclose(found.shN[:, : bands.shape[1]], bands, **close)
    assert not found.shN[:, bands.shape[1] :].any()
    turned = np.abs((found.quats * parameters["quats"]).sum(axis=1))
    lengths = np.linalg.norm(found.quats, axis=1) * np.linalg.norm(parameters["quats"], axis=1)
    np.testing.assert_allclose(turned, lengths, rtol=1e-5)
