"""Distance-conditioned attributes against the formulas, and vanilla where weights are zero."""

from dataclasses import fields, replace
from math import exp, log

import numpy as np
import pytest
import torch

from crossgrad_backbones.distance import DistanceConditioned, encoded, fitted_scale
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.contexts import RegularizeContext
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.fixtures import sample_camera, sample_phase, sample_scene, step_fields
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

CAMERAS = [view.camera for view in sample_scene().train_views]
CONDITIONS = ("condition_scales", "condition_opacities", "condition_colors")


def at(camera, *center):
    """The camera moved to a place."""
    pose = camera.world_to_camera.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(center, dtype=torch.float64)
    return replace(camera, world_to_camera=pose)


def encoding_by_loops(camera, cameras=CAMERAS):
    """(z, z^2) from the definition."""
    middle = np.mean([c.center.numpy() for c in cameras], axis=0)
    logs = [log(max(1e-3, np.linalg.norm(c.center.numpy() - middle))) for c in cameras]
    own = log(max(1e-3, np.linalg.norm(camera.center.numpy() - middle)))
    limits = [(each - np.mean(logs)) / np.std(logs) for each in logs]
    z = min(max((own - np.mean(logs)) / np.std(logs), min(limits)), max(limits))
    return np.array([z, z * z])


def with_weights(parameters, seed=0):
    rng = np.random.default_rng(seed)
    drawn = {
        name: torch.from_numpy(rng.normal(0, 0.3, tuple(tensor.shape))).float()
        for name, tensor in parameters.items()
        if name.startswith("distance_")
    }
    return {**parameters, **{name: tensor.requires_grad_() for name, tensor in drawn.items()}}


def same_bits(one, other):
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        equal = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
        assert equal, field.name


@pytest.mark.parametrize("camera", CAMERAS[::4])
def test_zero_weights_give_vanilla_bit_for_bit(camera):
    parameters = created(DistanceConditioned())
    vanilla = Vanilla().decode(created(Vanilla()), camera, sample_phase())
    same_bits(DistanceConditioned().decode(parameters, camera, sample_phase()), vanilla)
    baked = DistanceConditioned().bake(parameters, sample_phase(), CAMERAS)
    same_bits(baked, Vanilla().bake(created(Vanilla()), sample_phase(), CAMERAS))


@pytest.mark.parametrize(
    "camera", [*CAMERAS[::4], at(CAMERAS[0], 9, 9, 9), at(CAMERAS[0], 0, 0, 0)]
)
def test_the_encoding_is_the_standardised_log_distance_clamped_to_the_training_range(camera):
    scale = fitted_scale(CAMERAS)
    assert encoded(scale, [camera]).numpy() == pytest.approx(encoding_by_loops(camera), rel=1e-9)


def test_a_camera_at_the_mean_has_a_finite_encoding():
    cameras = [at(CAMERAS[0], *center) for center in ((1, 0, 0), (-1, 0, 0), (0, 0, 0))]
    for camera in cameras:
        found = encoded(fitted_scale(cameras), [camera]).numpy()
        assert found == pytest.approx(encoding_by_loops(camera, cameras), rel=1e-9)


@pytest.mark.parametrize("count", [1, 4])
def test_equal_distances_encode_to_zero_and_have_no_conditions(count):
    places = [(np.cos(a), np.sin(a), 0.0) for a in 2 * np.pi * np.arange(count) / count]
    cameras = [at(CAMERAS[0], *place) for place in places]
    assert encoded(fitted_scale(cameras), cameras[:1]).tolist() == [0.0, 0.0]
    views = [
        replace(view, camera=camera)
        for view, camera in zip(sample_scene().train_views, cameras, strict=False)
    ]
    scene = replace(sample_scene(), views=tuple(views), train=tuple(range(count)), test=())
    fitted, notes = DistanceConditioned(sh_degree=0).fitted_to(scene)
    assert fitted == DistanceConditioned(sh_degree=0, **dict.fromkeys(CONDITIONS, False))
    assert f"{count} training cameras are equally far" in notes[-1] and "left out" in notes[-1]
    asked = DistanceConditioned(sh_degree=0, **dict.fromkeys(CONDITIONS, True))
    kept, notes = asked.fitted_to(scene)
    assert kept == asked and "without effect" in notes[-1]
    assert DistanceConditioned().fitted_to(sample_scene())[0].condition_scales


@pytest.mark.parametrize("left_out", [None, *CONDITIONS])
def test_decoding_adds_weights_times_the_encoding(left_out):
    backbone = DistanceConditioned(**({left_out: False} if left_out else {}))
    parameters = with_weights(created(backbone))
    camera = CAMERAS[5]
    gaussians = backbone.decode(parameters, camera, sample_phase())
    raw = {name: tensor.detach().double().numpy() for name, tensor in parameters.items()}
    encoding = encoding_by_loops(camera)

    def weights(name, *shape):
        return raw.get(f"distance_{name}", np.zeros((len(raw["means"]), *shape, 2)))

    for i in range(len(raw["means"])):
        scale = sum(weights("scales", 1)[i, 0, k] * encoding[k] for k in range(2))
        logit = sum(weights("opacities")[i, k] * encoding[k] for k in range(2))
        for axis in range(3):
            color = sum(weights("f_dc", 1, 3)[i, 0, axis, k] * encoding[k] for k in range(2))
            wanted = raw["f_dc"][i, 0, axis] + color
            assert float(gaussians.sh_dc[i, 0, axis].detach()) == pytest.approx(wanted, abs=1e-6)
            wanted = exp(raw["scales"][i, axis] + scale)
            assert float(gaussians.scales[i, axis].detach()) == pytest.approx(wanted, rel=1e-5)
        wanted = 1 / (1 + exp(-raw["opacities"][i] - logit))
        assert float(gaussians.opacities[i].detach()) == pytest.approx(wanted, rel=1e-5)


def test_baking_is_exact_for_one_camera_and_uses_the_mean_encoding_for_several():
    backbone = DistanceConditioned()
    parameters = with_weights(created(backbone))
    for camera in CAMERAS[::4]:
        live = backbone.decode(parameters, camera, sample_phase()).detached()
        same_bits(backbone.bake(parameters, sample_phase(), [camera]), live)
    baked = backbone.bake(parameters, sample_phase(), CAMERAS)
    encoding = torch.tensor(np.mean([encoding_by_loops(camera) for camera in CAMERAS], axis=0))
    added = parameters["distance_opacities"].detach().double() @ encoding
    wanted = torch.sigmoid(parameters["opacities"].detach().double() + added)
    assert baked.opacities.numpy() == pytest.approx(wanted.numpy(), rel=1e-5)


def regularized(backbone, parameters, step, gaussians=None):
    fields = step_fields(step)
    return backbone.crossgrad_regularize(
        RegularizeContext(
            **fields, parameters=parameters, backbone=backbone, gaussians=gaussians, view=None
        )
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [1, 15_000, 30_000])
def test_the_penalty_contains_length_and_squared_derivative_at_the_training_cameras(step):
    backbone = DistanceConditioned(l2_weight=0.3, smoothness_weight=0.7)
    parameters = with_weights(created(backbone))
    total = 0.0
    for name in ("distance_scales", "distance_opacities", "distance_f_dc"):
        weights = parameters[name].detach().double().numpy()
        for w in weights.reshape(-1, 2):
            slopes = [w[0] + 2 * w[1] * encoding_by_loops(camera)[0] for camera in CAMERAS]
            total += 0.3 * (w[0] ** 2 + w[1] ** 2) + 0.7 * np.mean(np.square(slopes))
    wanted = total / len(parameters["means"]) * step / 30_000
    assert float(regularized(backbone, parameters, step).loss.detach()) == pytest.approx(wanted)


def test_the_penalty_is_absent_for_single_views_and_without_distance_conditions():
    parameters = created(DistanceConditioned())
    drawn = DistanceConditioned().decode(parameters, sample_camera(), sample_phase())
    assert regularized(DistanceConditioned(), parameters, 1, drawn) is None
    plain = DistanceConditioned(**dict.fromkeys(CONDITIONS, False))
    assert regularized(plain, created(plain), 1) is None


def test_a_reset_caps_the_opacity_at_every_distance():
    backbone, cap = DistanceConditioned(), 0.15
    parameters = with_weights(created(backbone))
    capped = {**parameters, "opacities": backbone.capped_opacities(parameters, cap)}
    scale = parameters["distances"]
    limits = (
        encoding_by_loops(at(CAMERAS[0], 0, 0, 1e-9))[0],
        encoding_by_loops(at(CAMERAS[0], 9, 9, 9))[0],
    )
    assert scale[5:].tolist() == pytest.approx(sorted(limits))
    z = torch.linspace(*scale[5:].tolist(), 2001, dtype=torch.float64)
    over_z = torch.stack([z, z * z], -1)
    added = parameters["distance_opacities"].detach().double() @ over_z.T
    before = torch.sigmoid(parameters["opacities"].detach().double()[:, None] + added).amax(1)
    after = torch.sigmoid(capped["opacities"].double()[:, None] + added).amax(1)
    assert after.numpy() == pytest.approx(before.clamp(max=cap).numpy(), rel=1e-4)
    assert (before < cap).any() and (before > cap).any()


def test_gradients_through_the_reference_rasterizer_pass_a_numerical_check():
    backbone = DistanceConditioned(sh_degree=0)
    parameters = with_weights(created(backbone))
    few = {
        name: tensor.detach().double()[: 6 if name != "distances" else None]
        for name, tensor in parameters.items()
    }
    names = ("scales", "opacities", "distance_scales", "distance_opacities", "distance_f_dc")

    def picture(*changed):
        given = {**few, **dict(zip(names, changed, strict=True))}
        gaussians = backbone.decode(given, sample_camera(), sample_phase())
        return TorchRasterizer().render(gaussians, sample_camera(), torch.zeros(3)).image.sum(0)

    inputs = [few[name].requires_grad_() for name in names]
    assert torch.autograd.gradcheck(picture, inputs, eps=1e-7, atol=1e-5)
