"""Gradients of anchors: against finite differences, and the fused pass against the plain one."""

from dataclasses import replace

import pytest
import torch
from support.extremes import jittered

from crossgrad_backbones.anchors import decode as decoding
from crossgrad_backbones.anchors.base import mean_volume
from crossgrad_backbones.anchors.heads import Seen
from crossgrad_backbones.scaffold import Scaffold
from crossgrad_core.contract.blocks import Edit, apply_to_parameters
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.testing.fixtures import sample_camera, sample_phase, sample_scene
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

CAMERA = replace(sample_camera(), width=9, height=6, fx=7.5, fy=7.5, cx=4.5, cy=3.0)
OPTIONS = [
    {},
    {"feature_bank": True, "offsets": 4},
    {"appearance": 3, "opacity_distance": True, "feature": 8},
    {"cov_distance": True, "offsets": 3},
]


def trained(backbone):
    return [name for block in backbone.trained_blocks() for name in block.tensors]


def double(backbone, parameters, rows):
    """The first anchors in float64; what is trained requires gradients."""
    few = apply_to_parameters(Edit(source=torch.arange(rows)), backbone.blocks(), parameters)
    names = trained(backbone)
    return {n: t.detach().double().requires_grad_(n in names) for n, t in few.items()}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_gradients_through_the_rasterizer_pass_a_numerical_check(options):
    backbone = Scaffold(**{"offsets": 2, "feature": 8, **options})
    parameters = double(backbone, jittered(backbone), 8)
    names = trained(backbone)
    phase = sample_phase()
    pattern = torch.sin(torch.arange(CAMERA.height * CAMERA.width * 3.0, dtype=torch.float64))

    def loss(*tensors):
        given = {**parameters, **dict(zip(names, tensors, strict=True))}
        gaussians = backbone.decode(given, CAMERA, phase)
        image = TorchRasterizer().render(gaussians, CAMERA, torch.zeros(3).double()).image
        return (image.flatten() * pattern).sum() + 3.0 * mean_volume(gaussians)

    tensors = [parameters[name] for name in names]
    assert len(backbone.decode(parameters, CAMERA, phase)) > 1
    assert torch.autograd.gradcheck(loss, tensors, eps=1e-6, atol=1e-6, rtol=1e-3, fast_mode=True)


def results(decode, dtype, backbone, parameters, seen, losses):
    """Gaussians, and the gradients of each loss by every trained tensor."""
    names = trained(backbone)
    given = {n: t.detach().to(dtype).requires_grad_(n in names) for n, t in parameters.items()}
    views = backbone.heads.views(given["anchors"].detach()[seen.rows] - CAMERA.center.to(dtype))
    code = given["appearance"][1] if backbone.appearance else None
    factor = None if seen.factor is None else seen.factor.to(dtype)
    gaussians = decode(backbone.heads, given, Seen(seen.rows, factor), views, code)
    found = []
    for loss in losses:
        gradients = torch.autograd.grad(
            loss(gaussians), [given[n] for n in names], retain_graph=True, allow_unused=True
        )
        found.append(dict(zip(names, gradients, strict=True)))
    return gaussians, found


def weighted(*names):
    """A loss over the given parts of Gaussians in which no two numbers count alike."""

    def loss(gaussians):
        flat = torch.cat([getattr(gaussians, name).flatten() for name in names])
        return (flat * torch.linspace(0.5, 1.5, flat.numel(), dtype=flat.dtype)).sum()

    return loss


#: Bound of a relative error: rounding of about a hundred terms.
GRADIENT = 128 * torch.finfo(torch.float32).eps

LOSSES = [
    weighted("means", "quats", "scales", "opacities", "colors"),
    mean_volume,
    weighted("means", "opacities"),
    weighted("colors"),
    weighted("quats", "scales"),
]


@pytest.mark.parametrize("faded", [False, True])
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_the_fused_pass_agrees_with_the_plain_pass(options, faded):
    backbone = Scaffold(**options)
    parameters = jittered(backbone)
    rows = torch.arange(0, len(parameters["anchors"]), 2)
    factor = (torch.arange(len(rows)) % 4) / 3.0 if faded else None
    seen = Seen(rows, factor)
    given = (backbone, parameters, seen, LOSSES)
    mine, gradients = results(decoding._fused, torch.float32, *given)
    plain, wanted = results(decoding._plain, torch.float64, *given)
    assert torch.equal(mine.origin, plain.origin) and torch.equal(mine.slot, plain.slot)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        have, want = getattr(mine, name).double(), getattr(plain, name)
        assert (have - want).norm() <= 1e-6 * want.norm()
    for each, exact in zip(gradients, wanted, strict=True):
        for name, tensor in parameters.items():
            have, want = (
                torch.zeros_like(tensor) if found.get(name) is None else found[name]
                for found in (each, exact)
            )
            size = want.norm()
            if name.startswith("mlp_bank"):
                # Its shares add up to 1: the gradient of a bias is the rest of a sum that cancels.
                size = torch.stack([norm_of(exact, n) for n in exact if "mlp_bank" in n]).max()
            assert (have.double() - want).norm() <= GRADIENT * size, name


def norm_of(gradients, name):
    gradient = gradients[name]
    return torch.zeros(()).double() if gradient is None else gradient.norm()


def test_decoding_in_several_chunks_agrees_with_the_plain_pass():
    backbone = Scaffold(offsets=2, feature=8)
    few = jittered(backbone)
    source = torch.arange(5000) % len(few["anchors"])
    many = apply_to_parameters(Edit(source=source), backbone.blocks(), few)
    many["features"] = many["features"].detach() + torch.randn(
        5000, 8, generator=torch.Generator().manual_seed(0)
    )
    given = (backbone, many, Seen(torch.arange(5000)), LOSSES[:2])
    mine, gradients = results(decoding._fused, torch.float32, *given)
    plain, wanted = results(decoding._plain, torch.float64, *given)
    assert torch.equal(mine.slot, plain.slot)
    for each, exact in zip(gradients, wanted, strict=True):
        for name, want in exact.items():
            if want is not None:
                assert (each[name].double() - want).norm() <= 1e-5 * want.norm(), name


def test_networks_without_influence_on_the_loss_get_no_gradient():
    backbone = Scaffold()
    parameters = jittered(backbone)
    _, (volume,) = results(
        decoding._fused, torch.float32, backbone, parameters, Seen(torch.arange(9)), [mean_volume]
    )
    idle = {name for name, gradient in volume.items() if gradient is None or not gradient.any()}
    assert "offsets" in idle
    assert {name for name in volume if name.startswith(("mlp_opacity", "mlp_color"))} <= idle
    assert not any(name.startswith("mlp_cov") for name in idle)


@pytest.mark.parametrize("anchors", [3000, 9001])
def test_the_bits_do_not_depend_on_the_number_of_threads(anchors):
    backbone = Scaffold()
    few = jittered(backbone)
    source = torch.arange(anchors) % len(few["anchors"])
    many = apply_to_parameters(Edit(source=source), backbone.blocks(), few)
    given = (backbone, many, Seen(torch.arange(anchors)), LOSSES[:2])
    found = []
    for threads in (1, 2):
        configure_threads(threads)
        found.append(results(decoding._fused, torch.float32, *given))
    configure_threads(1)
    (one, some), (two, others) = found
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(one, name), getattr(two, name))
    for each, other in zip(some, others, strict=True):
        for name, gradient in each.items():
            assert gradient is None or torch.equal(gradient, other[name]), name


@pytest.mark.parametrize("case", ["behind", "transparent", "one", "none"])
def test_views_with_few_or_no_gaussians_give_finite_gradients(case):
    backbone = Scaffold()
    parameters = {n: t.detach().clone() for n, t in jittered(backbone).items()}
    if case == "behind":
        parameters["anchors"] = (2.0 * CAMERA.center + parameters["anchors"]).float()
    if case == "transparent":
        parameters["mlp_opacity.2.bias"] -= 30.0
    if case in {"one", "none"}:
        rows = torch.arange(1 if case == "one" else 0)
        parameters = apply_to_parameters(Edit(source=rows), backbone.blocks(), parameters)
    names = trained(backbone)
    given = {n: t.detach().requires_grad_(n in names) for n, t in parameters.items()}
    gaussians = backbone.decode(given, CAMERA, sample_phase())
    assert (len(gaussians) > 0) == (case == "one")
    image = TorchRasterizer().render(gaussians, CAMERA, torch.full((3,), 0.5)).image
    loss = (image - 0.25).square().sum() + mean_volume(gaussians)
    gradients = torch.autograd.grad(loss, [given[n] for n in names], allow_unused=True)
    assert loss.isfinite()
    assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)


def test_the_volume_term_is_computed_from_the_gaussians_of_the_view():
    backbone = Scaffold()
    parameters = jittered(backbone)
    views = sample_scene().train_views
    gaussians = backbone.decode(parameters, views[0].camera, sample_phase())
    products = [float(s[0] * s[1] * s[2]) for s in gaussians.scales.detach().double()]
    wanted = sum(products) / len(products)
    assert float(mean_volume(gaussians)) == pytest.approx(wanted, rel=1e-5)
