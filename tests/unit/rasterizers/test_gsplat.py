"""Rasterizer `gsplat` held against the rule set, on gsplat's own plain-torch reference (CPU).

What only a GPU can show, the CUDA kernels themselves, is what `self_test` looks at before a run.
"""

import gc
import weakref
from dataclasses import replace

import pytest
import torch
from support import gsplat_on_cpu
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, TRANSMITTANCE_STOP
from crossgrad_plugins.rasterizers.gpu import blended
from crossgrad_plugins.rasterizers.gsplat_cuda import GsplatRasterizer
from crossgrad_plugins.rasterizers.reference.harmonics import harmonics
from crossgrad_plugins.rasterizers.reference.projection import project
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

reference = pytest.importorskip("gsplat.cuda._torch_impl")

OUTPUTS = GsplatRasterizer.provides
CAMERAS = {
    "middle": posed_camera(40, 28, focal=30.0, principal=(0.5, 0.5)),
    "off the axis": posed_camera(40, 28, focal=30.0, principal=(0.3, 0.8)),
    "wide": posed_camera(37, 19, focal=9.0),
}


@pytest.fixture
def gsplat(monkeypatch):
    gsplat_on_cpu.install(monkeypatch)
    return GsplatRasterizer()


def leaves(gaussians):
    return gaussians.mapped(lambda tensor: tensor.float().detach().requires_grad_())


def drawn(rasterizer, gaussians, camera, background=(0.1, 0.5, 0.3)):
    """A render, its loss's gradients and the Gaussians that have them."""
    render = rasterizer.render(gaussians, camera, torch.tensor(background), OUTPUTS)
    ramp = torch.linspace(0.5, 1.5, render.image.numel()).view(render.image.shape)
    (render.image * ramp).sum().add((render.alpha * ramp[..., 0]).sum()).backward()
    return render


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_gsplat_projection_agrees_with_the_reference(camera):
    """Compare means, depths, covariances and the Jacobian clamp in float64."""
    gaussians = random_gaussians(200, camera, seed=1, border=1.5)
    ours = project(gaussians.means, gaussians.quats, gaussians.scales, camera)
    covariances, _ = reference._quat_scale_to_covar_preci(
        gaussians.quats, gaussians.scales, compute_preci=False
    )
    pose, matrix = camera.world_to_camera[None], camera.matrix[None]
    _, means, depths, conics, _ = reference._fully_fused_projection(
        gaussians.means, covariances, pose, matrix, camera.width, camera.height, eps2d=0.3
    )
    dilated = torch.stack(
        [torch.stack([ours.xx + 0.3, ours.xy], -1), torch.stack([ours.xy, ours.yy + 0.3], -1)], -2
    )
    inverse = torch.linalg.inv(dilated)
    theirs = torch.stack([conics[0, :, 0], conics[0, :, 1], conics[0, :, 2]], -1)
    mine = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    torch.testing.assert_close(ours.means, means[0], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(ours.depths, depths[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsplat_spherical_harmonics_agree_with_the_reference(degree):
    directions = torch.nn.functional.normalize(
        torch.randn(100, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64), dim=1
    )
    theirs = reference._eval_sh_bases_fast((degree + 1) ** 2, directions)
    torch.testing.assert_close(harmonics(directions, degree), theirs, rtol=1e-6, atol=1e-7)


def test_gsplat_thresholds_equal_the_reference_except_the_alpha_cap():
    assert gsplat_on_cpu.THRESHOLD == ALPHA_THRESHOLD
    assert gsplat_on_cpu.STOP == TRANSMITTANCE_STOP
    assert GsplatRasterizer().max_alpha == gsplat_on_cpu.CAP
    with pytest.raises(ValueError, match=r"greater than or equal to 0\.999"):
        GsplatRasterizer(max_alpha=0.99)


def test_the_footprint_of_gsplat_is_never_smaller_than_the_reference():
    """gsplat ends at 3.33 standard deviations, which is beyond alpha = 1/255 at any opacity."""
    assert (2 * torch.tensor(255.0).log()).sqrt() < gsplat_on_cpu.EXTENT


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("sh_degree", [None, 3])
def test_gsplat_images_gradients_and_statistics_agree_with_the_reference(gsplat, camera, sh_degree):
    scene = random_gaussians(30, camera, seed=3, sh_degree=sh_degree, opacities=(0.1, 1.0))
    mine, theirs = leaves(scene), leaves(scene)
    ours = drawn(TorchRasterizer(max_alpha=0.999), mine, camera)
    other = drawn(gsplat, theirs, camera)
    for name in ("image", "alpha", "depth"):
        torch.testing.assert_close(getattr(other, name), getattr(ours, name), rtol=0, atol=3e-5)
    for name in ("mean_gradient", "abs_gradient"):
        same_direction(getattr(other.screen, name), getattr(ours.screen, name), 1e-3)
    for one, two in zip(theirs.floats(), mine.floats(), strict=True):
        same_direction(one.grad, two.grad, 1e-3)


def same_direction(found, expected, share):
    assert (found - expected).norm() <= share * expected.norm()


def test_gsplat_radii_equal_the_reference_for_visible_gaussians(gsplat):
    camera = CAMERAS["middle"]
    scene = leaves(random_gaussians(60, camera, seed=4, border=0.5))
    ours = TorchRasterizer(max_alpha=0.999).render(scene, camera, torch.zeros(3)).screen.radii
    theirs = gsplat.render(scene, camera, torch.zeros(3)).screen.radii
    seen = ours > 0
    assert torch.equal(theirs[seen], ours[seen])
    # Its box reaches into the image, which is no more than the ellipse and the rounding up do.
    assert 0 < (theirs[~seen] > 0).sum() < 0.25 * len(ours)


def test_gsplat_differs_from_the_default_only_by_its_alpha_cap_of_0_999(gsplat):
    """Only opacities above 0.99 differ, by at most 0.009."""
    camera = CAMERAS["middle"]
    at_centre = replace(
        random_gaussians(1, camera, border=-0.5, sigmas=(12.0, 13.0)),
        opacities=torch.tensor([1.0], dtype=torch.float64),
    )
    scene = leaves(at_centre)
    ours = TorchRasterizer().render(scene, camera, torch.zeros(3)).alpha.detach()
    theirs = gsplat.render(scene, camera, torch.zeros(3)).alpha.detach()
    assert float(ours.max()) == pytest.approx(0.99)
    assert 0.0 < (theirs - ours).max() <= 0.0091


@pytest.mark.sampled(2)
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("band", [1 << 19, 3 * 37])
def test_gsplat_pixel_counts_agree_with_the_reference(gsplat, monkeypatch, camera, band):
    """Count all pixels or a part of them, in two views, with any number of views per call."""
    monkeypatch.setattr(blended, "PIXELS", band)
    scenes = [leaves(random_gaussians(25, camera, seed=s, opacities=(0.5, 1.0))) for s in (10, 11)]
    marks = torch.rand(camera.height, camera.width, generator=torch.manual_seed(3)) < 0.3
    views = [(scene, camera) for scene in scenes]
    renders = gsplat.render_views(views, [torch.zeros(3)] * 2, OUTPUTS)
    for scene, render in zip(scenes, renders, strict=True):
        ours = TorchRasterizer(max_alpha=0.999).render(scene, camera, torch.zeros(3), OUTPUTS)
        assert torch.equal(render.screen.pixels, ours.screen.pixels)
        assert torch.equal(render.screen.count(marks), ours.screen.count(marks))
        assert render.screen.count(marks).dtype == torch.int32


@pytest.mark.parametrize(("sigmas", "most"), [((0.8, 4.0), 1e-5), ((0.05, 0.3), 6e-3)])
def test_gsplat_antialiasing_differs_noticeably_only_for_gaussians_below_a_pixel(
    gsplat, sigmas, most
):
    camera = CAMERAS["middle"]
    scene = leaves(
        random_gaussians(40, camera, seed=5, sigmas=sigmas, response="antialiased", border=0.0)
    )
    ours = TorchRasterizer(max_alpha=0.999).render(scene, camera, torch.zeros(3)).image
    theirs = gsplat.render(scene, camera, torch.zeros(3)).image
    assert 0.0 < (theirs - ours).abs().max() < most


def test_views_rendered_together_equal_views_rendered_one_by_one(gsplat):
    """The two views have different sizes and numbers of Gaussians. Results stay separate."""
    small = posed_camera(20, 12)
    moved = replace(CAMERAS["middle"], cx=15.0)
    cameras = [CAMERAS["middle"], small, moved, CAMERAS["middle"]]
    scenes = [random_gaussians(n, c, seed=n) for n, c in zip((20, 9, 20, 12), cameras, strict=True)]
    backgrounds = [torch.full((3,), 0.1 * k) for k in range(4)]
    alone, joint = [leaves(scene) for scene in scenes], [leaves(scene) for scene in scenes]
    one = [
        gsplat.render(g, c, b, OUTPUTS) for g, c, b in zip(alone, cameras, backgrounds, strict=True)
    ]
    together = gsplat.render_views(list(zip(joint, cameras, strict=True)), backgrounds, OUTPUTS)
    for renders in (one, together):
        sum((k + 1) * render.image.square().sum() for k, render in enumerate(renders)).backward()
    for k in range(4):
        torch.testing.assert_close(together[k].image, one[k].image)
        torch.testing.assert_close(together[k].depth, one[k].depth)
        assert torch.equal(together[k].screen.radii, one[k].screen.radii)
        for name in ("mean_gradient", "abs_gradient"):
            mine, other = getattr(together[k].screen, name), getattr(one[k].screen, name)
            torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-6)
        for a, b in zip(joint[k].floats(), alone[k].floats(), strict=True):
            torch.testing.assert_close(a.grad, b.grad, rtol=1e-4, atol=1e-5)


def test_an_empty_model_gives_the_background(gsplat):
    camera, none = CAMERAS["middle"], leaves(random_gaussians(0, CAMERAS["middle"]))
    some = leaves(random_gaussians(5, camera))
    grey, white = torch.full((3,), 0.5), torch.ones(3)
    first, second = gsplat.render_views([(none, camera), (some, camera)], [grey, white], OUTPUTS)
    assert (first.image == 0.5).all() and first.image.shape == (28, 40, 3)
    assert not first.alpha.any() and not first.depth.any() and not len(first.screen.radii)
    assert not len(first.screen.count(torch.ones(28, 40, dtype=torch.bool)))
    assert second.alpha.any()
    first.image.sum().backward()
    assert all(tensor.grad.shape == tensor.shape for tensor in none.floats())
    assert first.screen.mean_gradient.shape == first.screen.abs_gradient.shape == (0, 2)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("taken_back", [False, True])
def test_a_deleted_render_frees_its_memory(gsplat, monkeypatch, taken_back):
    centers = []

    def watched(means2d, *rest, **options):
        centers.append(weakref.ref(means2d))
        return gsplat_on_cpu.composited(means2d, *rest, **options)

    monkeypatch.setattr("gsplat.rendering.rasterize_to_pixels", watched)
    scene = leaves(random_gaussians(10, CAMERAS["middle"]))
    render = gsplat.render(scene, CAMERAS["middle"], torch.zeros(3), OUTPUTS)
    if taken_back:
        render.image.sum().backward()
    assert centers[0]() is not None
    del render
    gc.collect()
    assert centers[0]() is None
