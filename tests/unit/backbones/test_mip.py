"""Mip-Splatting's filters against the formulas, and its filter's times."""

from dataclasses import replace
from math import log, sqrt

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera

from crossgrad_backbones.mip import MipSplatting, filter_widths, renews, smoothed
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import Edit, apply_to_parameters
from crossgrad_core.contract.contexts import AfterStepContext
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.fixtures import sample_camera, sample_phase, sample_scene, step_fields
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import apply_edit
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

NEAR = 1e-3


def cameras():
    """Of different focal lengths, looking at the origin from different depths."""
    found = []
    for focal, depth in ((15.0, 1.0), (40.0, 3.0), (25.0, 1.5)):
        camera = posed_camera(focal=focal)
        pose = camera.world_to_camera.clone()
        pose[2, 3] = depth
        found.append(replace(camera, world_to_camera=pose))
    return found


def widths_by_loops(means, parity):
    """From the definition: least z / f over the cameras that see a mean."""
    longest = max(camera.fx for camera in cameras())
    finest = []
    for mean in means.double().numpy():
        sizes = []
        for camera in cameras():
            x, y, z = (camera.world_to_camera.numpy() @ [*mean, 1.0])[:3]
            u, v = (
                (camera.fx * x / z + camera.cx) / camera.width,
                (camera.fy * y / z + camera.cy) / camera.height,
            )
            if z > NEAR and -0.15 <= u <= 1.15 and -0.15 <= v <= 1.15:
                sizes.append(z / (longest if parity else camera.fx))
        finest.append(min(sizes, default=None))
    largest = max((each for each in finest if each is not None), default=0.0)
    return [sqrt(0.2) * (largest if each is None else each) for each in finest]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("parity", [False, True])
def test_filter_widths_agree_with_a_loop(parity):
    means = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (300, 3)))
    found = filter_widths(means, cameras(), NEAR, parity=parity)
    expected = widths_by_loops(means, parity)
    assert found.numpy() == pytest.approx(expected, rel=1e-12)
    largest = found == found.max()
    assert 1 < largest.sum() < 300


@pytest.mark.parametrize("means", [torch.full((3, 3), 1e3), torch.zeros(0, 3)])
def test_the_filter_width_is_zero_for_means_that_no_camera_sees(means):
    assert filter_widths(means, cameras(), NEAR, parity=False).tolist() == [0.0] * len(means)


def by_formulas(raw, widths, logits):
    """Scales and opacities in float64 from section 4."""
    s, w = np.exp(np.float64(raw)), np.float64(widths)[:, None]
    scales = np.sqrt(s**2 + w**2)
    factors = np.sqrt(np.prod(s**2 / (s**2 + w**2), axis=1))
    return scales, factors / (1 + np.exp(-np.float64(logits)))


def sizes(*sigmas):
    return torch.tensor(sigmas, dtype=torch.float64).log().float()[:, None].repeat(1, 3)


def test_decoding_enlarges_scales_and_reduces_opacities():
    backbone = MipSplatting()
    parameters = created(backbone)
    gaussians = backbone.decode(parameters, sample_camera(), sample_phase())
    raw = {name: tensor.detach() for name, tensor in parameters.items()}
    scales, opacities = by_formulas(raw["scales"], raw["filter"], raw["opacities"])
    assert gaussians.scales.detach().numpy() == pytest.approx(scales, rel=1e-5)
    assert gaussians.opacities.detach().numpy() == pytest.approx(opacities, rel=1e-5)
    assert (opacities < 0.99 / (1 + np.exp(-raw["opacities"].double().numpy()))).any()
    assert (gaussians.response, gaussians.dilation) == ("antialiased", 0.1)


def test_float32_represents_tiny_and_huge_scales():
    raw = sizes(1e-12, 1e-6, 1e-3, 1.0, 1e6).requires_grad_()
    logits = torch.linspace(-3, 3, 5).requires_grad_()
    widths = torch.full((5,), 1e-3)
    scales, opacities = smoothed(raw, logits, widths)
    wanted = by_formulas(raw.detach(), widths, logits.detach())
    assert scales.detach().numpy() == pytest.approx(wanted[0], rel=2e-6)
    assert opacities.detach().numpy() == pytest.approx(wanted[1], rel=5e-6, abs=0.0)
    (scales.log().sum() + opacities.log().sum()).backward()
    # d log S / d log s = (s / S)^2 and d log o / d log s = (w / S)^2 add up to 1 on each axis.
    assert raw.grad.numpy() == pytest.approx(np.ones((5, 3)), rel=1e-5)
    kept = 1 - torch.sigmoid(logits.detach())
    assert logits.grad.numpy() == pytest.approx(kept.numpy(), rel=1e-5)


@pytest.mark.parametrize("raw", [-300.0, -100.0, 100.0, 300.0])
def test_scales_beyond_float32_give_no_nan(raw):
    log_scales = torch.full((2, 3), raw, requires_grad=True)
    logits = torch.zeros(2, requires_grad=True)
    scales, opacities = smoothed(log_scales, logits, torch.tensor([0.0, 1e-3]))
    assert (scales > 0).all() and ((opacities >= 0) & (opacities <= 1)).all()
    torch.autograd.backward([scales, opacities], [torch.ones(2, 3), torch.ones(2)])
    assert not log_scales.grad.isnan().any() and not logits.grad.isnan().any()


def test_gradients_through_the_reference_rasterizer_pass_a_numerical_check():
    backbone = MipSplatting(sh_degree=0)
    parameters = created(backbone)
    few = {name: tensor.detach()[:6].double() for name, tensor in parameters.items()}
    few["scales"] = few["scales"] + log(0.3)

    def picture(means, scales, opacities):
        changed = {**few, "means": means, "scales": scales, "opacities": opacities}
        gaussians = backbone.decode(changed, sample_camera(), sample_phase())
        render = TorchRasterizer().render(gaussians, sample_camera(), torch.zeros(3))
        return render.image.sum(0)

    inputs = [few[name].requires_grad_() for name in ("means", "scales", "opacities")]
    assert torch.autograd.gradcheck(picture, inputs, eps=1e-7, atol=1e-5)


def test_a_reset_caps_the_filtered_opacity():
    backbone, cap = MipSplatting(), 0.01
    parameters = {
        "scales": sizes(1e-4, 1e-3, 1e-2, 1.0),
        "opacities": torch.full((4,), 2.0),
        "filter": torch.full((4,), 2e-3),
    }
    before = by_formulas(parameters["scales"], parameters["filter"], parameters["opacities"])[1]
    capped = backbone.capped_opacities(parameters, cap)
    after = by_formulas(parameters["scales"], parameters["filter"], capped)[1]
    assert after == pytest.approx(np.minimum(before, cap), rel=1e-5)
    assert before[0] < cap < before[1]
    assert float(capped[0]) == 2.0


@pytest.mark.parametrize(
    ("schedule", "steps"),
    [
        (Schedule.for_run(30_000), range(15_100, 30_000, 100)),
        (Schedule.for_run(3000), range(1510, 3000, 10)),
        (Schedule.for_run(7), range(4, 7)),
        (Schedule.for_run(1), []),
        (Schedule.for_run(7000, "absolute"), []),
        (Schedule.for_run(16_000, "absolute"), range(15_100, 16_000, 100)),
    ],
)
def test_the_filter_is_updated_in_the_last_half(schedule, steps):
    assert [s for s in range(1, schedule.total + 1) if renews(schedule, s)] == list(steps)


def after_step(parameters, *, step, edited):
    fields = step_fields(step)
    return MipSplatting().crossgrad_after_step(
        AfterStepContext(
            **fields, parameters=parameters, backbone=MipSplatting(), means_lr=1e-4, edited=edited
        )
    )


def test_an_update_of_the_filter_changes_no_other_tensor():
    parameters = created(MipSplatting())
    moved = {**parameters, "means": parameters["means"].detach() * 1.5}
    assert after_step(moved, step=15_050, edited=False) is None
    assert after_step(moved, step=15_100, edited=True) is None
    edit = after_step(moved, step=15_100, edited=False).edit
    assert list(edit.values) == ["filter"] and edit.source is None
    after = apply_to_parameters(edit, MipSplatting().blocks(), moved)
    prepared = MipSplatting().prepare(moved, sample_scene(), sample_phase())
    assert torch.equal(after["filter"], prepared["filter"])
    assert not torch.equal(after["filter"], parameters["filter"])
    assert not after["filter"].requires_grad


def test_an_edit_is_followed_by_a_new_filter():
    config = RunConfig(steps=10, backbone=ComponentChoice(name="mip"))
    setup = assemble(config, sample_scene(), "none")
    state = first_state(setup)
    before = state.parameters["filter"].clone()
    state.parameters["filter"] = torch.full_like(before, 9.0)
    assert apply_edit(setup, state, Edit(source=torch.tensor([3, 3, 5])))
    assert torch.equal(state.parameters["filter"], before[[3, 3, 5]])
