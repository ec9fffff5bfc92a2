"""Renders of the reference: closed forms, culling, and agreement with brute force."""

from dataclasses import replace
from math import ceil, erf, exp, log, pi, sqrt

import numpy as np
import pytest
import torch
from support.brute_force import trace
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

BLACK = torch.zeros(3, dtype=torch.float64)
EVERYTHING = frozenset({"depth", "pixels", "abs_gradient"})
FIELDS = ("means", "quats", "scales", "opacities", "colors")
RESPONSES = ("plain", "antialiased", "analytic")


def frontal(width=11, height=7, focal=20.0, cx=5.5, cy=3.5):
    """A camera at the origin that looks along z."""
    pose = torch.eye(4, dtype=torch.float64)
    return Camera(width, height, focal, focal, cx, cy, pose)


def stack(depths, opacities, sigma=0.1, **changes):
    """Round Gaussians on the optical axis of `frontal`, of primary colours in turn."""
    number = len(depths)
    means = torch.zeros(number, 3, dtype=torch.float64)
    means[:, 2] = torch.tensor(depths)
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(number, 1),
        scales=torch.full((number, 3), sigma, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        colors=torch.eye(3, dtype=torch.float64).repeat(number, 1)[:number],
    )
    return replace(gaussians, **changes)


def render(gaussians, camera, background=BLACK, **options):
    return TorchRasterizer(**options).render(gaussians, camera, background, EVERYTHING)


def test_a_single_gaussian_on_a_pixel_centre_agrees_with_the_formula():
    sigma2 = (20.0 * 0.1 / 2.0) ** 2 + 0.3
    result = render(stack([2.0], [0.8]), frontal())
    for dx, dy in ((0, 0), (1, 0), (0, -1), (2, 3), (-3, 1)):
        alpha = 0.8 * exp(-(dx * dx + dy * dy) / (2 * sigma2))
        expected = torch.tensor([alpha, 0.0, 0.0], dtype=torch.float64)
        torch.testing.assert_close(result.image[3 + dy, 5 + dx], expected, atol=0, rtol=1e-12)
        assert result.alpha[3 + dy, 5 + dx].item() == pytest.approx(alpha, rel=1e-12)
        assert result.depth[3 + dy, 5 + dx].item() == pytest.approx(2.0 * alpha, rel=1e-12)


def test_a_gaussian_touches_exactly_the_pixels_at_or_above_the_threshold():
    sigma2 = (20.0 * 0.1 / 2.0) ** 2 + 0.3
    result = render(stack([2.0], [0.8]), frontal())
    y, x = torch.meshgrid(torch.arange(7) - 3, torch.arange(11) - 5, indexing="ij")
    inside = 0.8 * torch.exp(-(x * x + y * y) / (2 * sigma2)) >= 1 / 255
    assert torch.equal(result.alpha > 0, inside)
    assert result.screen.pixels.tolist() == [inside.sum().item()]
    assert result.screen.radii.tolist() == [ceil(sqrt(2 * log(255 * 0.8) * sigma2))]


def test_the_nearer_gaussian_is_in_front_for_any_order_of_rows():
    # Red and green, the second nearer: green is drawn first.
    result = render(stack([3.0, 2.0], [0.5, 0.6]), frontal())
    expected = torch.tensor([0.4 * 0.5, 0.6, 0.0], dtype=torch.float64)
    torch.testing.assert_close(result.image[3, 5], expected)
    assert result.alpha[3, 5].item() == pytest.approx(1 - 0.4 * 0.5)
    assert result.depth[3, 5].item() == pytest.approx(2.0 * 0.6 + 3.0 * 0.2)


def test_gaussians_of_equal_depth_are_drawn_in_the_order_of_rows():
    result = render(stack([2.0, 2.0], [0.5, 0.6]), frontal())
    expected = torch.tensor([0.5, 0.5 * 0.6, 0.0], dtype=torch.float64)
    torch.testing.assert_close(result.image[3, 5], expected)


def test_the_background_fills_the_remaining_transmittance():
    background = torch.tensor([0.2, 0.4, 1.5], dtype=torch.float64)
    gaussians, camera = random_gaussians(20, posed_camera()), posed_camera()
    over_black = render(gaussians, camera)
    result = render(gaussians, camera, background)
    expected = over_black.image + (1 - over_black.alpha)[..., None] * background
    torch.testing.assert_close(result.image, expected)


def test_compositing_stops_before_the_transmittance_falls_below_the_limit():
    # Transmittance 0.05, 0.0025, 1.25e-4 and then 6.25e-6.
    camera = frontal(1, 1, cx=0.5, cy=0.5)
    result = render(stack([1.0, 2.0, 3.0, 4.0, 5.0], [0.95] * 4 + [0.1]), camera)
    assert result.screen.pixels.tolist() == [1, 1, 1, 0, 0]
    assert (result.screen.radii > 0).all()
    assert result.alpha.item() == pytest.approx(1 - 0.05**3, rel=1e-14)


def test_alpha_is_capped_and_the_cap_has_no_gradient():
    gaussians = stack([2.0], [1.0])
    gaussians.opacities.requires_grad_()
    result = render(gaussians, frontal(1, 1, cx=0.5, cy=0.5), max_alpha=0.999)
    result.image.sum().backward()
    assert result.alpha.item() == pytest.approx(0.999, rel=1e-15)
    assert gaussians.opacities.grad.tolist() == [0.0]


def test_the_principal_point_moves_the_image_by_whole_pixels():
    gaussians = random_gaussians(20, posed_camera(), border=0.0)
    camera = posed_camera()
    moved = replace(camera, cx=camera.cx + 2, cy=camera.cy - 1)
    here, there = render(gaussians, camera).image, render(gaussians, moved).image
    torch.testing.assert_close(there[:-1, 2:], here[1:, :-2])


def test_the_jacobian_is_clamped_around_the_principal_point():
    # Far to the right of the image the covariance is that of the clamped direction.
    camera = frontal(width=10, focal=20.0, cx=2.0)
    gaussians = stack([2.0], [0.9], sigma=2.0)
    gaussians.means[0, 0] = 4.0
    slope = (10 - 2.0) / 20.0 + 0.3 * 10 / 40.0
    xx = (20.0 * 2.0 / 2.0) ** 2 * (1 + slope**2) + 0.3
    radius = sqrt(2 * log(255 * 0.9) * xx)
    assert render(gaussians, camera).screen.radii.tolist() == [ceil(radius)]


def test_harmonics_of_degree_one_agree_with_a_calculation_by_hand():
    gaussians = stack([2.0], [0.5], colors=None, sh_degree=1)
    gaussians.means[0] = torch.tensor([0.3, -0.2, 2.0])
    dc = torch.tensor([[[0.1, -0.2, 0.3]]], dtype=torch.float64)
    rest = torch.arange(9, dtype=torch.float64).reshape(1, 3, 3) / 20
    gaussians = replace(gaussians, sh_dc=dc, sh_rest=rest)
    x, y, z = (gaussians.means[0] / gaussians.means[0].norm()).tolist()
    band0, band1 = 0.28209479177387814, 0.4886025119029199
    color = 0.5 + band0 * dc[0, 0] + band1 * (-y * rest[0, 0] + z * rest[0, 1] - x * rest[0, 2])
    result = render(gaussians, frontal(cx=2.5, cy=5.5))
    torch.testing.assert_close(result.image[3, 5] / result.alpha[3, 5], color)


def test_clamped_channels_and_inactive_bands_have_zero_gradient():
    gaussians = random_gaussians(20, posed_camera(), sh_degree=3)
    gaussians = replace(gaussians, sh_degree=1)
    gaussians.sh_dc[:, :, 0] = -10.0
    for tensor in (gaussians.sh_dc, gaussians.sh_rest):
        tensor.requires_grad_()
    render(gaussians, posed_camera()).image.square().sum().backward()
    assert (gaussians.sh_dc.grad[:, :, 0] == 0).all()
    assert (gaussians.sh_dc.grad[:, :, 1:] != 0).any()
    assert (gaussians.sh_rest.grad[:, 3:] == 0).all()
    assert (gaussians.sh_rest.grad[:, :3] != 0).any()


def test_the_antialiased_response_divides_opacity_by_the_increase_in_footprint_area():
    variance, dilation = (20.0 * 0.02 / 2.0) ** 2, 0.1
    gaussians = stack([2.0], [0.8], sigma=0.02, response="antialiased", dilation=dilation)
    det0, det1 = variance**2, (variance + dilation) ** 2
    expected = 0.8 * sqrt(det0 / (det1 + 1e-6) + 1e-6)
    assert render(gaussians, frontal()).alpha[3, 5].item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("sigma", [0.0031, 0.0032])
def test_the_antialiased_response_removes_gaussians_below_the_size_limit(sigma):
    # sigma px on either axis: determinants of 0.92e-6 and 1.05e-6 px^4 before dilation.
    pixels = sigma * 10.0
    gaussians = stack([2.0], [1.0], sigma=pixels / 10.0, response="antialiased", dilation=0.0)
    alpha = render(gaussians, frontal()).alpha[3, 5].item()
    assert (alpha > 0) == (pixels**4 > 1e-6)


@pytest.mark.parametrize("pixels", [1.0, 2.5, 20.0])
def test_the_analytic_response_integrates_over_the_pixel(pixels):
    gaussians = stack([2.0], [0.8], sigma=pixels / 10.0, response="analytic")
    result = render(gaussians, frontal())

    def window(offset):
        low, high = ((offset + side) / (pixels * sqrt(2)) for side in (-0.5, 0.5))
        return pixels * sqrt(pi / 2) * (erf(high) - erf(low))

    for dx, dy in ((0, 0), (1, 0), (2, -2)):
        expected = 0.8 * window(dx) * window(dy)
        # The published approximation of the normal distribution is good to 0.005 from 1 px on.
        assert result.alpha[3 + dy, 5 + dx].item() == pytest.approx(expected, abs=0.005)


def test_the_analytic_response_ignores_dilation():
    gaussians = random_gaussians(20, posed_camera(), response="analytic")
    wide = replace(gaussians, dilation=5.0)
    assert torch.equal(render(gaussians, posed_camera()).image, render(wide, posed_camera()).image)


@pytest.mark.sampled(13)
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("means", [0.0, 0.0, -2.0]),
        ("means", [0.0, 0.0, 0.0]),
        ("means", [0.0, 0.0, 0.5]),
        ("means", [float("nan"), 0.0, 2.0]),
        ("means", [0.0, float("inf"), 2.0]),
        ("means", [1e9, 0.0, 2.0]),
        ("opacities", 0.0039),
        ("opacities", float("nan")),
        ("quats", [0.0, 0.0, 0.0, 0.0]),
        ("quats", [1.0, float("nan"), 0.0, 0.0]),
        ("scales", [float("inf"), 0.1, 0.1]),
        ("scales", [float("nan"), 0.1, 0.1]),
        ("colors", [float("nan"), 0.1, 0.1]),
    ],
)
@pytest.mark.parametrize("response", RESPONSES)
def test_a_gaussian_that_cannot_be_rendered_does_not_change_the_image(field, value, response):
    good = stack([2.0, 3.0, 4.0], [0.5, 0.5, 0.5], response=response)
    getattr(good, field)[1] = torch.tensor(value, dtype=torch.float64)
    tensors = [good.means, good.quats, good.scales, good.opacities, good.colors]
    for tensor in tensors:
        tensor.requires_grad_()
    camera = frontal()
    result = render(good, camera, near=0.5)
    result.image.square().sum().backward()
    kept = torch.tensor([0, 2])
    rest = replace(good, **{n: getattr(good, n)[kept].detach() for n in FIELDS})
    assert torch.equal(result.image, render(rest, camera, near=0.5).image)
    assert result.screen.radii[1] == 0
    assert result.screen.pixels[1] == 0
    for gradient in (*(t.grad for t in tensors), result.screen.mean_gradient):
        assert gradient.isfinite().all()
        assert (gradient[1] == 0).all()
    assert (good.colors.grad[kept] != 0).any()


def test_a_flat_gaussian_seen_edge_on_is_dropped_without_dilation():
    gaussians = stack([2.0], [0.9], dilation=0.0)
    gaussians.scales[0, 0] = 0.0
    gaussians.scales.requires_grad_()
    result = render(gaussians, frontal())
    result.image.sum().backward()
    assert result.screen.radii.tolist() == [0]
    assert (gaussians.scales.grad == 0).all()


def test_an_empty_model_gives_the_background():
    gaussians = stack([], [])
    gaussians.means.requires_grad_()
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    result = render(gaussians, frontal(), background)
    result.image.sum().backward()
    assert torch.equal(result.image, background.expand(7, 11, 3))
    assert not result.alpha.any()
    assert gaussians.means.grad.shape == (0, 3)
    assert result.screen.mean_gradient.shape == (0, 2)


def assert_brute_force_agrees(gaussians, camera):
    expected, result = trace(gaussians, camera), render(gaussians, camera)
    np.testing.assert_allclose(result.image, expected.image, atol=1e-12)
    np.testing.assert_allclose(result.alpha, expected.alpha, atol=1e-12)
    np.testing.assert_allclose(result.depth, expected.depth, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(result.screen.pixels, expected.pixels)
    radii = np.where(expected.touched, np.ceil(expected.extents), 0)
    np.testing.assert_array_equal(result.screen.radii, radii)


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize(
    "ranges",
    [
        {},
        {"sigmas": (0.01, 0.5)},
        {"sigmas": (0.05, 60.0), "opacities": (0.0, 1.0)},
        {"depths": (1e-3, 1e3), "opacities": (0.9, 1.0), "border": 2.0},
    ],
    ids=["usual", "tiny", "needles", "stiff"],
)
def test_renders_agree_with_brute_force(response, ranges):
    camera = posed_camera(37, 21)
    assert_brute_force_agrees(random_gaussians(30, camera, response=response, **ranges), camera)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_harmonics_agree_with_brute_force(sh_degree):
    camera = posed_camera()
    assert_brute_force_agrees(random_gaussians(20, camera, sh_degree=sh_degree), camera)


def test_the_image_has_the_type_of_the_means():
    gaussians = random_gaussians(20, posed_camera())
    single = replace(gaussians, **{n: getattr(gaussians, n).float() for n in FIELDS})
    result, exact = render(single, posed_camera()), render(gaussians, posed_camera())
    assert result.image.dtype == torch.float32
    torch.testing.assert_close(result.image.double(), exact.image, atol=2e-6, rtol=0)


def test_optional_outputs_are_computed_only_if_requested():
    result = TorchRasterizer().render(stack([2.0], [0.5]), frontal(), BLACK)
    assert result.depth is None
    assert result.screen.pixels is None
    assert result.screen.abs_gradient is None


def test_gaussians_without_a_colour_are_refused():
    with pytest.raises(ValueError, match="`colors` or `sh_dc`"):
        render(stack([2.0], [0.5], colors=None), frontal())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("response", RESPONSES)
def test_cuda_renders_agree_with_cpu_renders(response):
    camera = posed_camera(37, 21)
    gaussians = random_gaussians(30, camera, response=response)
    moved = replace(gaussians, **{n: getattr(gaussians, n).cuda() for n in FIELDS})
    expected, result = render(gaussians, camera), render(moved, camera)
    torch.testing.assert_close(result.image.cpu(), expected.image)
    assert torch.equal(result.screen.pixels.cpu(), expected.screen.pixels)
