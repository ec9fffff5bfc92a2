"""The octree backbone: which anchors a camera uses, over training and out of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_backbones.octree import Octree
from crossgrad_backbones.scaffold import Scaffold
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import RunConfig
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import (
    posed_scene,
    posed_view,
    sample_camera,
    sample_phase,
    sample_scene,
)
from crossgrad_plugins.losses.l1_ssim import photometric_loss
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

WHOLE = {
    "round": round,
    "floor": math.floor,
    "ceil": math.ceil,
    "progressive": lambda detail: math.floor(detail + 1.0),
}
EVALUATION = sample_phase(training=False)


def scene_of(distances, points):
    """Cameras on the z axis that look at the points around the origin."""
    views = [
        posed_view(
            np.array([0.0, 0.0, -far]), f"{i:03}.png", forward=(0.0, 0.0, 1.0), up=(0.0, 1.0, 0.0)
        )
        for i, far in enumerate(distances)
    ]
    return posed_scene(views, np.asarray(points, float), ())


def leveled(seed=0, **options):
    """An octree of three levels on random points, with random features and extra levels."""
    rng = np.random.default_rng(seed)
    scene = scene_of([1.0, 2.0, 4.0], rng.uniform(-0.1, 0.1, (60, 3)))
    options = {"offsets": 2, "feature": 4, "visible_threshold": -1.0, **options}
    backbone = Octree(**{"middle_cell": 0.05, "plant_everywhere": True, **options})
    parameters = backbone.create(scene, rng)
    for name in ("features", "offsets"):
        parameters[name] = torch.from_numpy(rng.normal(size=parameters[name].shape)).float()
    extra = rng.uniform(0.0, 0.4, len(parameters["levels"]))
    parameters["extra_levels"] = torch.from_numpy(extra).float()
    return backbone, parameters, scene


def test_levels_and_lattice_agree_with_a_scene_calculated_by_hand():
    """Two cameras are 1 and 8 units away from a single point: D = 8, d = 1, four levels."""
    backbone = Octree(dist_ratio=1.0, base_layer=2, visible_threshold=0.0, plant_everywhere=True)
    scene = scene_of([1.0, 8.0], [[0.0, 0, 0], [1e-9, 0, 0]])
    parameters = backbone.create(scene, np.random.default_rng(0))
    lattice = Lattice.of(parameters["lattice"])
    assert lattice.count == 4
    assert float(lattice.distance) == pytest.approx(8.0, rel=1e-6)
    assert float(lattice.root_cell) == pytest.approx(1.1e-9 / 4)
    assert parameters["levels"].unique().tolist() == [0, 1, 2, 3]


def test_cameras_at_one_distance_need_one_level():
    backbone = Octree(visible_threshold=-1.0, middle_cell=0.005)
    scene = scene_of([2.0, 2.0, 2.0], [[0.0, 0, 0], [0.01, 0.02, 0], [0.0, 0.5, 0]])
    parameters = backbone.create(scene, np.random.default_rng(0))
    assert not parameters["levels"].any() and len(parameters["levels"]) == 3
    for step in (0, 30_000):
        used = backbone.used(parameters, scene.views[0].camera, sample_phase(step))
        assert used.mask.all()


def test_one_point_and_one_camera_create_one_anchor():
    backbone = Octree()
    parameters = backbone.create(scene_of([2.0], [[0.1, 0.1, 0.1]]), np.random.default_rng(0))
    assert parameters["anchors"].shape == (1, 3)
    baked = backbone.bake(parameters, EVALUATION, [scene_of([2.0], [[0.0] * 3]).views[0].camera])
    assert 0 < len(baked) <= 10


def test_the_automatic_threshold_removes_anchors_that_few_cameras_see():
    everything, some = leveled(visible_threshold=0.0), leveled(visible_threshold=-1.0)
    counts = [
        [int((parameters["levels"] == level).sum()) for level in range(3)]
        for _, parameters, _ in (everything, some)
    ]
    assert counts[0][0] == counts[1][0] > 0
    assert sum(counts[1]) < sum(counts[0])
    lattice = Lattice.of(some[1]["lattice"])
    cameras = torch.stack([view.camera.center for view in some[2].views])
    shares = lattice.shares(some[1]["anchors"].double(), some[1]["levels"], cameras)
    assert bool(((shares > lattice.visible_share) | (shares == 1)).all())


@pytest.mark.parametrize("rounding", WHOLE)
def test_used_anchors_and_their_fade_factors_agree_with_the_formula(rounding):
    backbone, parameters, scene = leveled(rounding=rounding, visible_threshold=0.0)
    root, fork, levels, distance = parameters["lattice"][3:7].tolist()
    camera = scene.views[1].camera
    used = backbone.used(parameters, camera, EVALUATION)
    factors = torch.ones(len(used.mask)) if used.factor is None else used.factor
    for i, level in enumerate(parameters["levels"].tolist()):
        half = 0.5 * root / fork**level
        center = [float(x) + half for x in parameters["anchors"][i]]
        far = math.dist(center, camera.center.tolist())
        detail = math.log(distance / far, fork) + float(parameters["extra_levels"][i])
        top = min(max(WHOLE[rounding](detail), 0), int(levels) - 1)
        assert bool(used.mask[i]) == (level <= top)
        boundary = rounding == "progressive" and level > 0 and level == math.floor(detail + 1)
        fraction = (detail + 1) % 1 if boundary else 1.0
        if level <= top:
            assert float(factors[i]) == pytest.approx(fraction, abs=1e-5)
    assert 0 < int(used.mask.sum()) < len(used.mask) or rounding in {"ceil", "progressive"}


def test_a_moving_camera_fades_levels_in_and_always_uses_the_coarsest_level():
    backbone, parameters, scene = leveled(rounding="progressive", visible_threshold=0.0)
    camera, before = scene.views[0].camera, None
    for far in np.geomspace(0.4, 40.0, 400):
        pose = camera.world_to_camera.clone()
        pose[2, 3] = far
        used = backbone.used(parameters, replace(camera, world_to_camera=pose), EVALUATION)
        strength = used.factor * used.mask
        assert strength[parameters["levels"] == 0].tolist() == [1.0] * int(
            (parameters["levels"] == 0).sum()
        )
        if before is not None:
            assert float((strength - before).abs().max()) < 0.03
        before = strength


@pytest.mark.parametrize(
    ("step", "top"), [(0, 1), (1, 1), (2499, 1), (2500, 2), (9_999, 2), (10_000, 2), (40_000, 2)]
)
def test_training_opens_levels_one_by_one_and_evaluation_uses_all_levels(step, top):
    """The run has three levels, 10,000 steps and a coarse phase of 2500 steps.

    One level opens later.
    """
    backbone, parameters, scene = leveled(visible_threshold=0.0)
    parameters["extra_levels"][:] = 9.0
    schedule = Schedule.for_run(10_000)
    for training in (True, False):
        used = backbone.used(parameters, scene.views[0].camera, Phase(step, training, schedule))
        finest = int(parameters["levels"][used.mask].max())
        assert finest == (top if training else 2)
    forced = backbone.model_copy(update={"init_level": 0})
    used = forced.used(parameters, scene.views[0].camera, Phase(step, True, schedule))
    assert int(parameters["levels"][used.mask].max()) == (top if step >= 2500 else step >= 1500)
    off = backbone.model_copy(update={"progressive": False})
    used = off.used(parameters, scene.views[0].camera, Phase(step, True, schedule))
    assert int(parameters["levels"][used.mask].max()) == 2


def test_rendered_gaussians_belong_to_used_anchors_and_have_faded_opacity():
    backbone, parameters, scene = leveled(rounding="progressive", visible_threshold=0.0)
    plain = backbone.model_copy(update={"rounding": "ceil"})
    camera = scene.views[1].camera
    faded = backbone.decode(parameters, camera, EVALUATION)
    full = plain.decode(parameters, camera, EVALUATION)
    factor = backbone.used(parameters, camera, EVALUATION).factor[faded.origin]
    assert torch.equal(faded.origin, full.origin) and len(faded) > 0
    assert torch.allclose(faded.opacities, full.opacities * factor)
    assert float(factor.min()) < 1.0


def test_a_camera_that_sees_nothing_gets_no_gaussians_and_no_gradient():
    backbone, parameters, scene = leveled()
    view = scene.views[0]
    pose = view.camera.world_to_camera.clone()
    pose[2, 3] = -5.0
    camera = replace(view.camera, world_to_camera=pose)
    gaussians = backbone.decode(parameters, camera, sample_phase())
    assert len(gaussians) == 0 and not gaussians.decoded.any()
    render = TorchRasterizer().render(gaussians, camera, torch.ones(3))
    assert torch.equal(render.image, torch.ones_like(render.image))
    target = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    loss = photometric_loss(render.image, target, None, 0.2)
    assert math.isfinite(float(loss.detach()))


def test_baking_for_a_far_camera_omits_fine_levels():
    backbone, parameters, scene = leveled()
    near, far = (scene.views[i].camera for i in (0, 2))
    counts = []
    for camera in (near, far):
        used = backbone.used(parameters, camera, EVALUATION)
        drawn = backbone.decode(parameters, camera, EVALUATION)
        baked = backbone.bake(parameters, EVALUATION, [camera])
        assert len(baked) >= len(drawn) - int((drawn.opacities < 1 / 255).sum()) > 0
        assert len(baked) <= 2 * int(used.mask.sum())
        counts.append(len(baked))
    assert counts[0] > counts[1]


def test_gradients_through_the_reference_rasterizer_pass_a_numerical_check():
    backbone, parameters, scene = leveled(
        rounding="progressive", visible_threshold=0.0, offsets=1, feature=2
    )
    parameters["anchors"] = parameters["anchors"].double()
    camera = replace(scene.views[1].camera, width=4, height=3, fx=40.0, fy=40.0, cx=2.0, cy=1.5)
    used = backbone.used(parameters, camera, EVALUATION)
    assert 0.0 < float(used.factor[used.mask].min()) < 1.0
    of_level = [used.mask & (parameters["levels"] == level) for level in range(3)]
    rows = torch.cat([mask.nonzero()[:1, 0] for mask in of_level])
    assert len(rows) == 3
    per_primitive = {b.name for b in backbone.blocks() if b.per_primitive}
    chosen = {
        name: (tensor[rows] if name in per_primitive else tensor).detach()
        for name, tensor in parameters.items()
    }
    trained = [name for block in backbone.trained_blocks() for name in block.tensors]
    values = [chosen[name].double().requires_grad_() for name in trained]
    weights = torch.linspace(0.5, 1.5, 4 * 3 * 3, dtype=torch.float64).view(3, 4, 3)

    def rendered(*tensors):
        merged = {**chosen, **dict(zip(trained, tensors, strict=True))}
        gaussians = backbone.decode(merged, camera, EVALUATION)
        assert len(gaussians) > 0
        background = torch.zeros(3, dtype=torch.float64)
        image = TorchRasterizer().render(gaussians, camera, background).image
        return (image * weights).sum()

    assert torch.autograd.gradcheck(rendered, values, eps=1e-6, atol=1e-6, rtol=1e-4)
    assert all(g.any() for g in torch.autograd.grad(rendered(*values), values))


def test_the_lattice_tensor_contains_all_values_that_decoding_needs():
    scene = sample_scene()
    backbone = Octree()
    parameters = backbone.create(scene, np.random.default_rng(0))
    fields = Lattice.of(parameters["lattice"])
    low = 1.1 * float(scene.points.min())
    assert fields.origin.tolist() == pytest.approx([low] * 3)
    assert float(fields.fork) == 2 and float(fields.lead) == 0.5
    assert float(fields.visible_share) == 0.01
    assert not any(parameters[name].requires_grad for name in ("levels", "extra_levels", "lattice"))


@pytest.mark.parametrize("backbone", [Octree(), Scaffold()])
def test_a_start_without_visible_gaussians_is_reported(backbone):
    scene = sample_scene()
    faint = Vanilla().bake(
        Vanilla().create(scene, np.random.default_rng(0)), EVALUATION, [sample_camera()]
    )
    rng = np.random.default_rng(0)
    started = backbone.adopt(faint, scene, rng)
    assert len(started["anchors"]) > 0
    faint = replace(faint, opacities=torch.full_like(faint.opacities, 1e-3))
    with pytest.raises(UserError, match="opaque enough to become an anchor"):
        backbone.adopt(faint, scene, rng)


def test_densifier_anchor_works_on_octree_but_densifier_octree_needs_a_lattice():
    config = {"backbone": {"name": "octree"}, "densifier": {"name": "anchor"}, "steps": 200}
    assemble(RunConfig.model_validate(config), sample_scene(), "none")
    for other in ("scaffold", "vanilla"):
        config = {"backbone": {"name": other}, "densifier": {"name": "octree"}, "steps": 200}
        with pytest.raises(IncompatibleSelectionError, match="lattice"):
            assemble(RunConfig.model_validate(config), sample_scene(), "none")


def test_omitted_anchors_are_reported_with_the_option():
    assert "plant_everywhere=true" in Octree().fitted_to(sample_scene())[1][0]
    assert Octree(plant_everywhere=True).fitted_to(sample_scene())[1] == ()


def test_an_outlier_camera_does_not_determine_the_levels():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3))
    distances = np.linspace(1.0, 4.0, 10)
    lattices = [
        Octree().create(scene_of(each, points), np.random.default_rng(0))["lattice"]
        for each in (distances, [*distances, 1e5])
    ]
    assert torch.equal(*lattices)
