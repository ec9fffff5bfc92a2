"""Gradients of the reference against finite differences, and its screen statistics."""

from dataclasses import replace

import pytest
import torch
from support.brute_force import trace
from support.gaussians import posed_camera, random_gaussians, smooth_gaussians

from crossgrad_plugins.rasterizers.reference import compositing
from crossgrad_plugins.rasterizers.reference.projection import project
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

BLACK = torch.zeros(3, dtype=torch.float64)
RESPONSES = ("plain", "antialiased", "analytic")
CAMERA = posed_camera(18, 10, focal=12.0)


def render(gaussians, camera=CAMERA, outputs=frozenset({"depth", "pixels", "abs_gradient"})):
    return TorchRasterizer().render(gaussians, camera, BLACK, outputs)


def check_gradients(gaussians, names, *, every_entry=True):
    """gradcheck of random weightings of image, alpha and depth by some tensors.

    By every entry of them, or in one random direction of each tensor, which is much quicker.
    """
    rng = torch.Generator().manual_seed(5)
    shapes = [(10, 18, 3), (10, 18), (10, 18)]
    weights = [torch.randn(*s, generator=rng, dtype=torch.float64) for s in shapes]

    def outputs(*tensors):
        result = render(replace(gaussians, **dict(zip(names, tensors, strict=True))))
        images = (result.image, result.alpha, result.depth)
        return tuple((w * x).sum() for w, x in zip(weights, images, strict=True))

    tensors = [getattr(gaussians, name).clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(
        outputs, tensors, eps=1e-6, atol=1e-7, rtol=1e-6, fast_mode=not every_entry
    )


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize(
    "every_entry", [False, pytest.param(True, marks=pytest.mark.slow, id="every entry")]
)
def test_gradients_of_geometry_opacity_and_rgb_pass_a_numerical_check(response, every_entry):
    gaussians = smooth_gaussians(20, CAMERA, response=response)
    names = ("means", "quats", "scales", "opacities", "colors")
    check_gradients(gaussians, names, every_entry=every_entry)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_gradients_of_spherical_harmonics_pass_a_numerical_check(sh_degree):
    gaussians = smooth_gaussians(20, CAMERA, sh_degree=sh_degree)
    check_gradients(gaussians, ("means",))
    names = ("sh_dc", "sh_rest") if sh_degree else ("sh_dc",)
    check_gradients(gaussians, names, every_entry=False)


@pytest.mark.parametrize("response", RESPONSES)
def test_gradients_at_clamped_jacobians_and_capped_alphas_pass_a_numerical_check(response):
    gaussians = smooth_gaussians(
        24, CAMERA, sigmas=(4.0, 30.0), opacities=(0.5, 1.3), border=1.0, response=response
    )
    drawn = render(gaussians).screen.radii > 0
    u = project(gaussians.means, gaussians.quats, gaussians.scales, CAMERA).means[:, 0]
    assert (drawn & ((u < -0.15 * 18) | (u > 1.15 * 18))).any()
    assert (trace(gaussians, CAMERA).raw > 0.99).any()
    names = ("means", "quats", "scales", "opacities", "colors")
    check_gradients(gaussians, names, every_entry=False)


def leaves(gaussians):
    """The same Gaussians with tensors that collect gradients, and those tensors."""
    names = ("means", "quats", "scales", "opacities", "colors")
    tensors = {name: getattr(gaussians, name).clone().requires_grad_() for name in names}
    return replace(gaussians, **tensors), list(tensors.values())


@pytest.mark.parametrize("response", RESPONSES)
def test_mean_gradients_add_up_to_the_gradient_of_the_principal_point(response):
    # Moving every projected mean is moving the principal point, where no Jacobian is clamped.
    gaussians, _ = leaves(smooth_gaussians(24, CAMERA, border=0.1, response=response))
    weight = torch.randn(10, 18, 3, generator=torch.Generator().manual_seed(1)).double()

    def loss(dx, dy):
        camera = replace(CAMERA, cx=CAMERA.cx + dx, cy=CAMERA.cy + dy)
        return (weight * render(gaussians, camera).image).sum()

    result = render(gaussians)
    (weight * result.image).sum().backward()
    step = 1e-6
    with torch.no_grad():
        expected = [
            (loss(step, 0) - loss(-step, 0)) / (2 * step),
            (loss(0, step) - loss(0, -step)) / (2 * step),
        ]
    torch.testing.assert_close(
        result.screen.mean_gradient.sum(0), torch.stack(expected), rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("response", RESPONSES)
def test_absolute_gradients_are_sums_over_pixels(response):
    camera = posed_camera(6, 4, focal=6.0)
    gaussians, _ = leaves(random_gaussians(8, camera, response=response))
    weight = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(1)).double()
    result = render(gaussians, camera)
    signed, absolute = torch.zeros(8, 2).double(), torch.zeros(8, 2).double()
    for y in range(4):
        for x in range(6):
            (weight * result.image)[y, x].sum().backward(retain_graph=True)
            signed += result.screen.mean_gradient
            absolute += result.screen.mean_gradient.abs()
    (weight * result.image).sum().backward()
    torch.testing.assert_close(result.screen.mean_gradient, signed)
    torch.testing.assert_close(result.screen.abs_gradient, absolute)
    assert (absolute > signed.abs() + 1e-6).any()


def test_a_backward_pass_to_colours_alone_still_fills_the_statistics():
    gaussians = random_gaussians(20, CAMERA)
    both, _ = leaves(gaussians)
    colors = gaussians.colors.clone().requires_grad_()
    result, expected = render(replace(gaussians, colors=colors)), render(both)
    torch.autograd.grad(result.image.square().sum(), [colors])
    expected.image.square().sum().backward()
    assert torch.equal(result.screen.mean_gradient, expected.screen.mean_gradient)


def test_absolute_gradients_are_computed_only_if_requested():
    gaussians, _ = leaves(random_gaussians(20, CAMERA))
    result = render(gaussians, outputs=frozenset())
    result.image.sum().backward()
    assert result.screen.mean_gradient.abs().sum() > 0
    assert result.screen.abs_gradient is None


@pytest.mark.sampled(1)
@pytest.mark.parametrize("response", RESPONSES)
def test_rendering_tiles_again_for_the_backward_pass_changes_no_bit(response, monkeypatch):
    camera = posed_camera(37, 21)
    gaussians = random_gaussians(40, camera, response=response)

    def everything():
        scene, tensors = leaves(gaussians)
        result = render(scene, camera)
        (result.image.square().sum() + result.depth.sum()).backward()
        screen = result.screen
        gradients = [tensor.grad for tensor in tensors]
        return [result.image, *gradients, screen.mean_gradient, screen.abs_gradient, screen.pixels]

    remembered = everything()
    monkeypatch.setattr(compositing, "REMEMBERED_ENTRIES", 0)
    for once, twice in zip(remembered, everything(), strict=True):
        assert torch.equal(once, twice)


def test_the_same_input_gives_the_same_bits():
    camera = posed_camera(64, 48)
    gaussians = random_gaussians(500, camera)
    single = {n: getattr(gaussians, n).float() for n in ("means", "quats", "scales", "opacities")}
    gaussians = replace(gaussians, **single, colors=gaussians.colors.float())

    def gradients():
        scene, tensors = leaves(gaussians)
        render(scene, camera).image.square().sum().backward()
        return [tensor.grad for tensor in tensors]

    for first, second in zip(gradients(), gradients(), strict=True):
        assert torch.equal(first, second)
