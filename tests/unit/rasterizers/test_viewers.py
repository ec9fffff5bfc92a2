"""Drawing rules of programs that show Gaussians, against closed forms of a single Gaussian."""

import math

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import VIEWERS
from crossgrad_plugins.rasterizers import viewers
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

SIZE, FOCAL, DEPTH, OPACITY = 61, 100.0, 4.0, 0.8
CAMERA = Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, torch.eye(4, dtype=torch.float64))


def one(sigma: float, across: float = 0.0, **fields: object) -> Gaussians:
    """A white round Gaussian whose standard deviation is `sigma` pixels, on the optical axis."""
    values = {
        "means": torch.tensor([[across * DEPTH / FOCAL, 0.0, DEPTH]], dtype=torch.float64),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        "scales": torch.full((1, 3), sigma * DEPTH / FOCAL, dtype=torch.float64),
        "opacities": torch.tensor([OPACITY], dtype=torch.float64),
        "colors": torch.ones((1, 3), dtype=torch.float64),
    }
    return Gaussians(**{**values, **fields})


def squares(variance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared distances from the middle pixel in standard deviations, and both offsets."""
    offsets = (np.arange(SIZE) - SIZE // 2) / math.sqrt(variance)
    y, x = np.meshgrid(offsets, offsets, indexing="ij")
    return x * x + y * y, x, y


def expected(alpha: np.ndarray, inside: np.ndarray) -> np.ndarray:
    return np.where(inside & (alpha >= 1 / 255), alpha, 0.0)


def image_of(viewer, gaussians: Gaussians) -> np.ndarray:
    image = viewer(gaussians, CAMERA)
    assert image.shape == (SIZE, SIZE, 3)
    assert torch.equal(image[..., 0], image[..., 2])
    return image[..., 0].numpy()


def test_mkkellogg_cuts_a_gaussian_at_the_root_of_8():
    r2, *_ = squares(25.0 + 0.3)
    wanted = expected(OPACITY * np.exp(-r2 / 2), r2 <= 8)
    np.testing.assert_allclose(image_of(viewers.mkkellogg, one(5.0)), wanted, atol=1e-12)
    # The cut removes alphas far above 1/255.
    assert 0 < wanted[wanted > 0].min() < OPACITY * math.exp(-4) * 1.2


def test_playcanvas_draws_a_falloff_that_is_zero_at_the_cut():
    r2, *_ = squares(25.0 + 0.3)
    end = math.exp(-4)
    wanted = expected(OPACITY * (np.exp(-r2 / 2) - end) / (1 - end), r2 <= 8)
    np.testing.assert_allclose(image_of(viewers.playcanvas, one(5.0)), wanted, atol=1e-12)


def test_spark_reduces_the_opacity_by_the_area_of_the_dilation():
    for sigma in (0.5, 5.0):
        variance = sigma**2 + 0.3
        r2, *_ = squares(variance)
        alpha = OPACITY * sigma**2 / variance * np.exp(-r2 / 2)
        wanted = expected(alpha, r2 <= 8)
        np.testing.assert_allclose(image_of(viewers.spark, one(sigma)), wanted, atol=1e-12)


def test_cesium_cuts_along_the_main_axes_and_dilates_by_a_sixteenth():
    r2, x, y = squares(25.0 + 0.3 / 16)
    inside = (np.abs(x) <= math.sqrt(8)) & (np.abs(y) <= math.sqrt(8))
    wanted = expected(OPACITY * np.exp(-r2 / 2), inside)
    np.testing.assert_allclose(image_of(viewers.cesium, one(5.0)), wanted, atol=1e-12)
    # Corners of the rectangle are outside the ellipse.
    assert (wanted[r2 > 8] > 0).any()


def test_cesium_does_not_draw_gaussians_below_a_third_of_a_pixel():
    assert image_of(viewers.cesium, one(0.32)).max() == 0.0
    assert image_of(viewers.cesium, one(0.34)).max() > 0.5


@pytest.mark.parametrize(("viewer", "frame"), [("mkkellogg", 1.2), ("cesium", 1.2), ("spark", 1.4)])
def test_a_gaussian_whose_centre_is_far_outside_the_frame_is_not_drawn(viewer, frame):
    draw = getattr(viewers, viewer)
    edge = frame * SIZE / 2
    assert image_of(draw, one(20.0, across=edge - 0.5)).max() > 0.0
    assert image_of(draw, one(20.0, across=edge + 0.5)).max() == 0.0
    assert image_of(viewers.playcanvas, one(20.0, across=edge + 0.5)).max() > 0.0


def test_mkkellogg_draws_two_bands_of_spherical_harmonics():
    rest = torch.zeros((1, 15, 3), dtype=torch.float64)
    rest[:, 11] = 0.5  # the zonal coefficient of band 3
    dc = torch.ones((1, 1, 3), dtype=torch.float64)
    given = {"colors": None, "sh_dc": dc, "sh_rest": rest, "sh_degree": 3}
    shown = {name: image_of(getattr(viewers, name), one(5.0, **given)).max() for name in NAMES}
    assert shown["mkkellogg"] == pytest.approx((0.5 + 0.28209479) * OPACITY, abs=1e-6)
    assert shown["cesium"] > shown["mkkellogg"] + 0.1


NAMES = ("cesium", "mkkellogg", "playcanvas", "spark")


def test_the_viewers_of_the_command_are_these_functions():
    assert tuple(registry.entries(VIEWERS)) == NAMES
    for name in NAMES:
        entry = registry.find(VIEWERS, name)
        assert registry.resolve_entry(entry) is getattr(viewers, name)


def test_many_gaussians_are_blended_front_to_back_as_the_reference_does():
    camera = posed_camera()
    gaussians = random_gaussians(200, camera)
    black = torch.zeros(3, dtype=gaussians.means.dtype)
    wanted = TorchRasterizer().render(gaussians, camera, black).image
    # Without the rules of a program, the renderer follows those of crossgrad up to the cut.
    found = viewers.drawn(gaussians, camera, viewers.Rules())
    assert (found - wanted).abs().max() < 0.06
    assert (found - wanted).abs().mean() < 5e-3
