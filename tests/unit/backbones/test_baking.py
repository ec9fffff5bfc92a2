"""Plain Gaussians in place of those of other responses: by the formulas, and on trained scenes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.scenes import write_tiny_scene

from crossgrad_backbones.baking import as_plain
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.run.assemble import assemble, read_scene
from crossgrad_core.run.export import ExportOptions, export_scene
from crossgrad_core.testing.fixtures import sample_gaussians, sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

CAMERAS = [view.camera for view in sample_scene().train_views]
NEAR = 1e-3


def covariance_2d(mean, rotation, scales, camera):
    """[2, 2] covariance on the image by the Jacobian of the projection, px^2."""
    pose = camera.world_to_camera[:3, :3].numpy()
    x, y, z = pose @ mean + camera.world_to_camera[:3, 3].numpy()
    jacobian = np.array(
        [[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]]
    )
    axes = jacobian @ pose @ rotation
    return axes @ np.diag(scales**2) @ axes.T


def expected(gaussians, cameras, blur):
    """Scales and opacities, Gaussian by Gaussian; every camera sees every one of them."""
    rotations = Rotation.from_quat(np.roll(gaussians.quats.double().numpy(), -1, axis=1))
    scales, opacities = [], []
    for i, mean in enumerate(gaussians.means.double().numpy()):
        depths = [float((c.world_to_camera.numpy() @ [*mean, 1.0])[2]) for c in cameras]
        pixel = min(depth / c.fx for depth, c in zip(depths, cameras, strict=True))
        own = gaussians.scales[i].double().numpy()
        left = np.sqrt(np.maximum(own**2 - (0.3 - blur) * pixel**2, 1e-4 * own**2))
        ratios = []
        for camera in cameras:
            live = covariance_2d(mean, rotations[i].as_matrix(), own, camera)
            drawn = covariance_2d(mean, rotations[i].as_matrix(), left, camera) + 0.3 * np.eye(2)
            ratios.append(np.sqrt(np.linalg.det(live) / np.linalg.det(drawn)))
        scales.append(left)
        opacities.append(min(1.0, float(gaussians.opacities[i]) * max(ratios)))
    return np.array(scales), np.array(opacities)


@pytest.mark.parametrize("blur", [0.1, 1 / 12])
@pytest.mark.parametrize("cameras", [CAMERAS[:1], CAMERAS], ids=["one", "all"])
@pytest.mark.parametrize("size", [1.0, 0.1, 0.01])
def test_baked_scales_and_opacities_agree_with_the_formulas(blur, cameras, size):
    gaussians = sample_gaussians(harmonics=True).detached()
    gaussians = replace(gaussians, scales=gaussians.scales * size, response="analytic")
    baked = as_plain(gaussians, cameras, blur, NEAR)
    scales, opacities = expected(gaussians, cameras, blur)
    assert baked.scales.numpy() == pytest.approx(scales, rel=1e-5)
    assert baked.opacities.numpy() == pytest.approx(opacities, rel=1e-4)
    assert baked.response == "plain" and baked.dilation is None


def test_baking_leaves_gaussians_outside_all_views_unchanged():
    gaussians = sample_gaussians(harmonics=True).detached()
    away = replace(gaussians, means=gaussians.means + 100.0)
    baked = as_plain(away, CAMERAS, 0.1, NEAR)
    assert torch.allclose(baked.scales, away.scales, rtol=1e-6)
    assert torch.equal(baked.opacities, away.opacities)


@pytest.mark.parametrize("size", [1e-12, 1e6])
def test_baking_keeps_extreme_sizes_finite_and_positive(size):
    gaussians = sample_gaussians(harmonics=True).detached()
    baked = as_plain(replace(gaussians, scales=gaussians.scales * size), CAMERAS, 0.1, NEAR)
    assert (baked.scales > 0).all() and baked.scales.isfinite().all()
    assert ((baked.opacities >= 0) & (baked.opacities <= 1)).all()


def test_baking_an_empty_model_works():
    none = Gaussians(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    assert len(as_plain(none, CAMERAS, 0.1, NEAR)) == 0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("size", [1.0, 0.25, 0.03])
@pytest.mark.parametrize(
    ("response", "dilation", "blur"), [("antialiased", 0.1, 0.1), ("analytic", 0.0, 1 / 12)]
)
def test_baking_removes_most_of_the_error_of_the_plain_response(response, dilation, blur, size):
    live = sample_gaussians(400, harmonics=True).detached()
    live = replace(live, scales=live.scales * size, response=response, dilation=dilation)
    for camera in CAMERAS[::3]:
        wanted = picture(live, camera)
        wrong = picture(replace(live, response="plain", dilation=None), camera) - wanted
        left = picture(as_plain(live, [camera], blur, NEAR), camera) - wanted
        assert left.square().mean() < wrong.square().mean() / 25


def picture(gaussians, camera):
    return TorchRasterizer().render(gaussians, camera, torch.zeros(3)).image


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(folder, views=9)
    return folder


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("backbone", "most"), [("analytic", 0.02), ("mip", 0.02), ("distance", 0)])
def test_a_trained_scene_loses_little_quality_at_the_camera_it_is_baked_for(
    backbone, most, scene, tmp_path
):
    choice = ComponentChoice(name=backbone)
    config = RunConfig(scene=str(scene), steps=150, schedule_unit="steps", backbone=choice)
    setup = assemble(config, read_scene(config, scene)[0], "colmap")
    state = first_state(setup)
    for _ in range(60):
        timed_step(setup, state)
    for view in (setup.train_views[0], setup.scene.test_views[0]):
        exported = export_scene(
            setup, state, tmp_path / "baked.ply", options=ExportOptions(view.name)
        )
        assert exported.live_psnr > 14.0
        assert abs(exported.loss) <= most
