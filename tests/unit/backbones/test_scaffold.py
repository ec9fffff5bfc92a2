"""Initial anchors, learning rates and baking of backbone scaffold."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.extremes import jittered

from crossgrad_backbones.anchors.voxels import automatic_voxel_size, voxel_centers
from crossgrad_backbones.scaffold import Scaffold
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.contexts import RegularizeContext
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_phase, sample_scene, step_fields
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

SCENE = sample_scene()
VIEWS = SCENE.train_views
SH_C1 = 0.4886025119029199
EVALUATION = sample_phase(training=False)


def created(seed=0, **options):
    return Scaffold(**options).create(SCENE, np.random.default_rng(seed))


def test_every_occupied_voxel_has_one_anchor_in_its_middle():
    voxel = 0.03
    cells = {tuple(round(float(x) / voxel) for x in point) for point in SCENE.points}
    anchors = created(voxel_size=voxel)["anchors"]
    found = {tuple(round(float(x) / voxel) for x in anchor) for anchor in anchors}
    assert len(anchors) == len(cells) < len(SCENE.points)
    assert found == cells
    middles = torch.tensor([[c * voxel for c in cell] for cell in sorted(cells)])
    assert torch.allclose(anchors, middles, atol=1e-7)


def test_the_automatic_voxel_is_twice_the_median_distance_to_the_nearest_point():
    points = SCENE.points
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    wanted = 2.0 * np.median(distances.min(axis=1))
    assert automatic_voxel_size(points) == pytest.approx(wanted)
    assert float(created()["voxel_size"]) == pytest.approx(wanted)


@pytest.mark.parametrize(
    "points", [np.zeros((1, 3)), np.zeros((5, 3)), np.full((2, 3), 7e4)], ids=["one", "same", "far"]
)
def test_degenerate_point_clouds_also_get_anchors(points):
    size = automatic_voxel_size(points)
    assert size > 0
    assert len(voxel_centers(points, size)) == 1


def test_initial_scales_are_the_distances_to_three_neighbours():
    parameters = created()
    anchors = parameters["anchors"].double().numpy()
    distances = np.linalg.norm(anchors[:, None] - anchors[None], axis=2)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    wanted = 0.5 * np.log(np.maximum((nearest**2).mean(axis=1), 1e-7))
    scales = parameters["scales"].detach().numpy()
    np.testing.assert_allclose(scales, np.repeat(wanted[:, None], 6, axis=1), rtol=1e-4)
    assert not parameters["offsets"].any() and not parameters["features"].any()


def test_networks_are_initialized_uniformly_like_linear_layers():
    parameters = created(feature=32, offsets=40)
    for name, width in (("mlp_cov.0", 35), ("mlp_cov.2", 32)):
        for kind in ("weight", "bias"):
            values = parameters[f"{name}.{kind}"].detach().numpy()
            assert np.abs(values).max() <= width**-0.5
            if kind == "weight":
                assert values.std() == pytest.approx((width * 3.0) ** -0.5, rel=0.05)
    other = created(seed=1, feature=32, offsets=40)
    assert not torch.equal(parameters["mlp_cov.0.weight"], other["mlp_cov.0.weight"])


def test_learning_rates_equal_the_published_rates():
    rates = {b.name: b.lr for b in Scaffold(feature_bank=True, appearance=4).blocks()}
    table = {
        "anchors": (0.0, 0.0),
        "offsets": (0.01, 1e-4),
        "features": (0.0075, 0.0075),
        "scales": (0.007, 0.007),
        "mlp_opacity": (0.002, 2e-5),
        "mlp_cov": (0.004, 0.004),
        "mlp_color": (0.008, 5e-5),
        "mlp_bank": (0.01, 1e-5),
        "appearance": (0.05, 5e-4),
    }
    for name, (first, last) in table.items():
        assert (rates[name].at(0.0), rates[name].at(1.0)) == pytest.approx((first, last))


def test_learning_rates_published_as_constant_may_decay():
    finals = {"lr_features_final": 1e-4, "lr_scales_final": 2e-4, "lr_cov_final": 3e-4}
    rates = {b.name: b.lr.at(1.0) for b in Scaffold(**finals).blocks()}
    names = ("features", "scales", "mlp_cov")
    assert [rates[name] for name in names] == pytest.approx([1e-4, 2e-4, 3e-4])
    frozen = {b.name: b.lr for b in Scaffold(lr_features=0.0, lr_features_final=1e-4).blocks()}
    assert frozen["features"].at(0.5) == 0.0


def test_a_training_view_uses_its_appearance_code_and_any_other_view_the_mean():
    backbone = Scaffold(appearance=3)
    parameters = backbone.create(SCENE, np.random.default_rng(0))

    def colors(camera, phase):
        return backbone.decode(parameters, camera, phase).colors.detach()

    camera, training = VIEWS[2].camera, sample_phase()
    own = colors(camera, training)
    mean = colors(camera, EVALUATION)
    assert not torch.allclose(own, mean)
    stranger = replace(camera, world_to_camera=camera.world_to_camera.clone())
    stranger.world_to_camera[0, 3] += 1e-9
    assert torch.allclose(colors(stranger, training), mean, atol=1e-5)
    with torch.no_grad():
        parameters["appearance"][:] = parameters["appearance"][2].clone()
    assert torch.allclose(colors(camera, EVALUATION), own, atol=1e-5)


def regularized(backbone, gaussians):
    context = RegularizeContext(
        **step_fields(), parameters={}, backbone=backbone, gaussians=gaussians, view=VIEWS[0]
    )
    return backbone.crossgrad_regularize(context)


def test_the_volume_is_regularized_per_view():
    gaussians = Gaussians(
        torch.zeros(2, 3),
        torch.zeros(2, 4),
        torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 4.0]]),
        torch.zeros(2),
    )
    assert float(regularized(Scaffold(), gaussians).loss) == pytest.approx(0.01 * (6.0 + 1.0) / 2)
    nothing = gaussians.mapped(lambda tensor: tensor[:0])
    assert float(regularized(Scaffold(), nothing).loss) == 0.0
    assert regularized(Scaffold(), None) is None
    assert regularized(Scaffold(volume_weight=0.0), gaussians) is None


def test_a_ply_gives_anchors_at_its_visible_gaussians():
    means = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])
    gaussians = Gaussians(
        means, torch.zeros(3, 4), torch.ones(3, 3), torch.tensor([0.5, 0.001, 0.9])
    )
    adopted = Scaffold(voxel_size=0.1).adopt(gaussians, SCENE, np.random.default_rng(0))
    assert torch.allclose(adopted["anchors"], means[[0, 2]], atol=1e-6)


def spread():
    """A backbone whose anchors are partly out of sight, and its parameters."""
    backbone = Scaffold(offsets=4)
    parameters = {n: t.detach().clone() for n, t in jittered(backbone).items()}
    parameters["anchors"] *= 6.0
    return backbone, parameters


@pytest.mark.parametrize("view", [0, 3, 7])
def test_baking_for_one_camera_keeps_the_gaussians_that_the_camera_sees(view):
    backbone, parameters = spread()
    camera = VIEWS[view].camera
    live = backbone.decode(parameters, camera, EVALUATION).detached()
    baked = backbone.bake(parameters, EVALUATION, [camera])
    # Those out of sight are in the file too.
    assert len(baked) > (live.opacities >= 1 / 255).sum()
    rows = {n: t[live.decoded] if len(t.shape) > 1 and len(t) == len(live.decoded) else t
            for n, t in parameters.items()}  # fmt: skip
    assert 0 < len(rows["anchors"]) < len(live.decoded)
    within = backbone.bake(rows, EVALUATION, [camera])
    rasterizer, black = TorchRasterizer(), torch.zeros(3)
    seen, drawn, whole = (
        rasterizer.render(each, camera, black).image for each in (live, within, baked)
    )
    assert seen.max() > 0.05
    assert (drawn - seen).abs().max() < 1e-5
    # A few Gaussians of anchors out of sight reach into the image.
    assert (whole - seen).abs().mean() < 1e-3


def looks(backbone, parameters, camera):
    """(anchor, slot) -> opacity, mean, scales, unit quaternion, colour, direction of the view."""
    found = backbone.decode(parameters, camera, EVALUATION)
    quats = torch.nn.functional.normalize(found.quats)
    directions = torch.nn.functional.normalize(found.means - camera.center.float())
    parts = (found.means, found.scales, quats, found.colors, directions)
    table = {}
    for i, key in enumerate(zip(found.origin.tolist(), found.slot.tolist(), strict=True)):
        table[key] = (float(found.opacities[i]), *(part[i].double().numpy() for part in parts))
    return found.decoded, table


def fitted(parts):
    """Weighted least squares of colours by direction, band 1 held back by a hundredth."""
    total = sum(part[0] for part in parts)
    rows, wanted = [], []
    for opacity, _, _, _, color, (x, y, z) in parts:
        basis = np.array([SH_C0, -SH_C1 * y, SH_C1 * z, -SH_C1 * x])
        rows.append(np.sqrt(opacity) * basis)
        wanted.append(np.sqrt(opacity) * (color - 0.5))
    for k in (1, 2, 3):
        rows.append(np.sqrt(0.01 * total * SH_C1**2 / 3) * np.eye(4)[k])
        wanted.append(np.zeros(3))
    return np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]


def averaged(tables, anchor, slot, views):
    """What is baked for one slot: (mean, scales, quaternion, opacity, SH), None if faint."""
    parts = [table[anchor, slot] for _, table in tables if (anchor, slot) in table]
    total = sum(part[0] for part in parts)
    if total / views < 1 / 255:
        return None
    scales = sum(part[0] * part[2] for part in parts) / total
    rotation = np.zeros(4)
    for opacity, _, _, quat, _, _ in parts:
        rotation += opacity * (quat if quat @ rotation >= 0 else -quat)
    rotation /= np.linalg.norm(rotation)
    return parts[0][1], scales, rotation, total / views, fitted(parts)


def test_baking_for_several_cameras_averages_over_the_cameras_that_see_an_anchor():
    backbone, parameters = spread()
    cameras = [view.camera for view in VIEWS]
    tables = [looks(backbone, parameters, camera) for camera in cameras]
    views = torch.stack([decoded for decoded, _ in tables]).sum(0)
    assert views.min() > 0 and 0 < views.median() < len(cameras)
    baked = backbone.bake(parameters, EVALUATION, cameras)
    wanted = [
        found
        for anchor, count in enumerate(views.tolist())
        for slot in range(backbone.offsets)
        if (found := averaged(tables, anchor, slot, count)) is not None
    ]
    assert len(baked) == len(wanted) > 10 and baked.sh_degree == 1
    means, scales, quats, opacities, colors = (np.array(w) for w in zip(*wanted, strict=True))
    close = {"rtol": 1e-4, "atol": 1e-5}
    np.testing.assert_allclose(baked.means, means, **close)
    np.testing.assert_allclose(baked.scales, scales, **close)
    np.testing.assert_allclose(baked.opacities, opacities, **close)
    np.testing.assert_allclose(np.abs((baked.quats.double().numpy() * quats).sum(1)), 1.0, **close)
    harmonics = torch.cat([baked.sh_dc, baked.sh_rest], 1)
    np.testing.assert_allclose(harmonics, colors, rtol=1e-3, atol=1e-3)


def test_an_anchor_that_no_camera_sees_is_baked_for_all_cameras():
    backbone, parameters = spread()
    cameras = [view.camera for view in VIEWS[:2]]
    behind = replace(
        cameras[0],
        world_to_camera=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
        @ cameras[0].world_to_camera,
    )
    assert not backbone.decode(parameters, behind, EVALUATION).decoded.any()
    baked = backbone.bake(parameters, EVALUATION, [behind])
    wide = replace(cameras[0], width=4000, height=4000, cx=2000.0, cy=2000.0)
    seen = backbone.decode(parameters, wide, EVALUATION)
    assert seen.decoded.all()
    drawn = seen.opacities >= 1 / 255
    np.testing.assert_allclose(baked.means, seen.means[drawn].detach(), atol=1e-5)
    np.testing.assert_allclose(baked.opacities, seen.opacities[drawn].detach(), atol=1e-5)


def test_evenly_chosen_cameras_are_limited_in_number():
    from crossgrad_backbones.anchors.baking import evenly

    cameras = [VIEWS[i % len(VIEWS)].camera for i in range(100)]
    chosen = evenly(cameras, 32)
    assert len(chosen) == 32 and chosen[0] is cameras[0] and chosen[16] is cameras[50]
    assert evenly(cameras[:5], 32) == cameras[:5]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("options", [{}, {"appearance": 2, "feature_bank": True}])
def test_training_lowers_the_loss(options):
    config = RunConfig(
        steps=60,
        initializer=ComponentChoice(name="points"),
        backbone=ComponentChoice(name="scaffold", **options),
        operator=ComponentChoice(name="pcgrad"),
        sampler=ComponentChoice(name="random"),
        schedule_unit="steps",
        densify_from=10,
        densify_until=50,
        densify_every=10,
    )
    setup = assemble(config, SCENE, "none")
    state = first_state(setup)
    losses = [sum(timed_step(setup, state).losses) for _ in range(60)]
    assert sum(losses[-20:]) < 0.9 * sum(losses[:20])
    assert all(t.isfinite().all() for t in state.parameters.values())
