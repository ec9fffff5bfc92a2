"""Tests that need a GPU: kernels, synchronisation within a step, and whole runs.

Skipped where there is no CUDA device, as in CI; `docs/rasterizers.md` says how to run them on one.
"""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera, random_gaussians
from torch import Tensor

from crossgrad_core.commands import assemble, begin, configured
from crossgrad_core.contract.blocks import AdamState
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_core.training.adam.axes import step_along_axes
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.step import final_edits
from crossgrad_core.training.strided_rendering import as_in_full, camera_of
from crossgrad_plugins.losses.l1_ssim import photometric_loss
from crossgrad_plugins.losses.photometric.reference import l1_ssim_loss
from crossgrad_plugins.rasterizers.gsplat_cuda import GsplatRasterizer
from crossgrad_plugins.rasterizers.gswarp_cuda import GswarpRasterizer
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer
from crossgrad_plugins.rules.dropout import Dropout

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    # Of the packages and of torch, whose versions are the machine's.
    pytest.mark.filterwarnings("default"),
]

RASTERIZERS = {"gsplat": GsplatRasterizer, "gswarp": GswarpRasterizer}
#: Options with which rasterizer `torch` draws by the same rules.
ALIKE = {"gsplat": {"max_alpha": 0.999}, "gswarp": {"footprint": "3-sigma"}}
REFERENCES = {name: TorchRasterizer(**options) for name, options in ALIKE.items()}
CAMERAS = {
    "middle": posed_camera(160, 120, focal=130.0, principal=(0.5, 0.5)),
    "narrow": posed_camera(333, 9, focal=200.0, principal=(0.5, 0.5)),
    "one pixel": posed_camera(1, 1, focal=1.0, principal=(0.5, 0.5)),
}
#: One step between neighbouring values of alpha at the edge of a footprint.
EDGE = 1.0 / 255.0
TENSORS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


@pytest.fixture(params=RASTERIZERS)
def name(request):
    if not RASTERIZERS[request.param].speed("cuda"):
        pytest.skip(f"{request.param} is not installed, or cannot compile its kernels")
    return request.param


@pytest.fixture
def gsplat():
    if not GsplatRasterizer.speed("cuda"):
        pytest.skip("gsplat is not installed, or cannot compile its kernels")
    return GsplatRasterizer()


def leaves(gaussians, device, dtype):
    return gaussians.mapped(lambda each: each.detach().to(device, dtype).requires_grad_())


def drawn(rasterizer, gaussians, camera):
    """Image and gradients, on the CPU in float64, and the render."""
    background = torch.tensor([0.1, 0.5, 0.3]).to(gaussians.means)
    render = rasterizer.render(gaussians, camera, background, rasterizer.provides)
    ramp = torch.linspace(0.5, 1.5, render.image.numel()).view(render.image.shape)
    (render.image * ramp.to(render.image)).sum().backward()
    own = {name: getattr(gaussians, name) for name in TENSORS}
    gradients = {n: t.grad.double().cpu() for n, t in own.items() if isinstance(t, Tensor)}
    return render.image.detach().double().cpu(), gradients, render


def same_gradients(found, expected, share):
    """But for a few Gaussians, of which a pixel at the edge of a footprint fell the other way."""
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        assert found[name].isfinite().all(), name
        errors = (found[name] - gradient).flatten(1 if gradient.dim() > 1 else 0)
        lengths = errors.norm(dim=1) if gradient.dim() > 1 else errors.abs()
        usual = lengths.sort().values[:-4] if len(lengths) > 4 else lengths
        assert usual.norm() <= share * gradient.norm(), name
        assert lengths.norm() <= 0.1 * gradient.norm() + 1e-6, name


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sh_degree", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_images_and_gradients_agree_with_the_float64_reference(name, seed, sh_degree, camera):
    scene = random_gaussians(400, camera, seed=seed, sh_degree=sh_degree, opacities=(0.05, 0.95))
    image, gradients, _ = drawn(RASTERIZERS[name](), leaves(scene, "cuda", torch.float32), camera)
    # What is rounded the other way at a threshold is rounded so before the oracle draws it.
    rounded = leaves(scene.mapped(lambda each: each.float()), "cpu", torch.float64)
    expected, wanted, _ = drawn(REFERENCES[name], rounded, camera)
    error = (image - expected).abs()
    assert error.max() <= 3 * EDGE
    assert error.mean() <= 2e-5
    same_gradients(gradients, wanted, 5e-3)


@pytest.mark.parametrize("sh_degree", [None, 3])
def test_antialiased_gaussians_agree_with_the_reference_rasterizer(gsplat, sh_degree):
    camera = CAMERAS["middle"]
    scene = random_gaussians(400, camera, sh_degree=sh_degree, response="antialiased")
    image, gradients, _ = drawn(gsplat, leaves(scene, "cuda", torch.float32), camera)
    expected, wanted, _ = drawn(REFERENCES["gsplat"], leaves(scene, "cpu", torch.float64), camera)
    assert (image - expected).abs().max() <= 3 * EDGE
    same_gradients(gradients, wanted, 5e-3)


@pytest.mark.parametrize(("stride", "corner"), [(2, (0, 0)), (2, (1, 0)), (3, (2, 1)), (8, (5, 7))])
def test_strided_views_have_the_pixels_of_the_full_image(gsplat, stride, corner):
    camera, behind = CAMERAS["middle"], torch.zeros(3, device="cuda")
    # Nobody stands beyond the border, where positions are clamped by the size of the image.
    scene = leaves(random_gaussians(400, camera, border=0.0), "cuda", torch.float32)
    whole = gsplat.render(scene, camera, behind).image
    small = camera_of(camera, stride, corner)
    image = gsplat.render(as_in_full(scene, gsplat, stride), small, behind).image
    error = (image - whole[corner[1] :: stride, corner[0] :: stride]).abs()
    assert error.max() <= 3 * EDGE
    assert error.mean() <= 2e-5


def extremes():
    camera = CAMERAS["middle"]
    usual = random_gaussians(300, camera, seed=5)
    some = torch.arange(300) % 7 == 0

    def changed(**tensors):
        return replace(usual, **tensors)

    eye = camera.center
    return {
        "tiny": changed(scales=usual.scales * 1e-6),
        "huge": changed(scales=torch.where(some[:, None], 1e3, usual.scales)),
        "needles": changed(scales=usual.scales * torch.tensor([1e2, 1e-5, 1.0])),
        "nearly opaque": changed(opacities=torch.full((300,), 0.9999, dtype=torch.float64)),
        "faint": changed(opacities=torch.full((300,), 1e-3, dtype=torch.float64)),
        "long quaternions": changed(quats=usual.quats * 1e6),
        "at the camera": changed(means=torch.where(some[:, None], eye + 1e-4, usual.means)),
        "behind": changed(means=torch.where(some[:, None], 2 * eye - usual.means, usual.means)),
        "all in one place": changed(means=usual.means[:1].expand(300, 3).clone()),
        "one": usual.mapped(lambda each: each[:1]),
        "far away": changed(means=eye + 1e4 * (usual.means - eye), scales=usual.scales * 1e4),
    }


@pytest.mark.parametrize("case", extremes())
def test_extreme_gaussians_agree_with_the_float64_reference(name, case):
    """Compare images. Gradients must be finite and not longer than in the reference."""
    camera, scene = CAMERAS["middle"], extremes()[case]
    image, gradients, _ = drawn(RASTERIZERS[name](), leaves(scene, "cuda", torch.float32), camera)
    rounded = leaves(scene.mapped(lambda each: each.float()), "cpu", torch.float64)
    expected, wanted, _ = drawn(REFERENCES[name], rounded, camera)
    assert image.isfinite().all()
    assert (image - expected).abs().mean() <= 1e-3
    for tensor, gradient in gradients.items():
        assert gradient.isfinite().all(), tensor
        assert gradient.norm() <= 2 * wanted[tensor].norm() + 1e-3, tensor


@pytest.mark.parametrize("seed", range(3))
def test_views_rendered_together_equal_views_rendered_one_by_one(gsplat, seed):
    camera = CAMERAS["middle"]
    scenes = [random_gaussians(200, camera, seed=10 * seed + k, sh_degree=2) for k in range(3)]
    together = [leaves(scene, "cuda", torch.float32) for scene in scenes]
    alone = [leaves(scene, "cuda", torch.float32) for scene in scenes]
    behind = torch.zeros(3, device="cuda")
    views = [(scene, camera) for scene in together]
    outputs = gsplat.provides
    joint = gsplat.render_views(views, [behind] * 3, outputs)
    torch.stack([render.image.square().sum() for render in joint]).sum().backward()
    for scene, own, render in zip(alone, together, joint, strict=True):
        single = gsplat.render(scene, camera, behind, outputs)
        single.image.square().sum().backward()
        torch.testing.assert_close(single.image, render.image, rtol=0, atol=1e-6)
        for field in ("mean_gradient", "abs_gradient"):
            one, other = getattr(single.screen, field), getattr(render.screen, field)
            assert (one - other).norm() <= 1e-4 * one.norm()
        assert torch.equal(single.screen.pixels, render.screen.pixels)
        for one, other in zip(scene.floats(), own.floats(), strict=True):
            assert (one.grad - other.grad).norm() <= 1e-4 * one.grad.norm()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_pixel_counts_agree_with_the_reference(gsplat, camera):
    scene = random_gaussians(300, camera, seed=3, opacities=(0.3, 0.95))
    _, _, ours = drawn(gsplat, leaves(scene, "cuda", torch.float32), camera)
    _, _, theirs = drawn(REFERENCES["gsplat"], leaves(scene, "cpu", torch.float32), camera)
    found, expected = ours.screen.pixels.cpu(), theirs.screen.pixels
    # A pixel at the edge of a footprint may fall either way.
    assert (found - expected).abs().sum() <= 1e-3 * expected.sum() + 1
    marked = torch.rand(camera.height, camera.width, generator=torch.manual_seed(1)) < 0.3
    some, others = ours.screen.count(marked.cuda()), ours.screen.count(~marked.cuda())
    assert torch.equal(some + others, ours.screen.pixels)


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_agrees_between_gpu_and_cpu(masked):
    random = torch.Generator().manual_seed(7)
    image = torch.rand(61, 83, 3, generator=random)
    photo = torch.randint(0, 256, (61, 83, 3), generator=random, dtype=torch.uint8)
    mask = torch.rand(61, 83, generator=random) < 0.8 if masked else None
    exact = image.double().requires_grad_()
    l1_ssim_loss(exact, photo, mask).backward()
    ours = image.cuda().requires_grad_()
    loss = photometric_loss(ours, photo.cuda(), None if mask is None else mask.cuda())
    loss.backward()
    expected = float(l1_ssim_loss(exact, photo, mask).detach())
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    assert (ours.grad.cpu().double() - exact.grad).norm() <= 1e-4 * exact.grad.norm()


def test_adam_agrees_between_gpu_and_cpu():
    random = torch.Generator().manual_seed(8)
    shapes = {"a": (1000, 3), "b": (1000,), "c": (1000, 15, 3)}
    start = {name: torch.randn(shape, generator=random) for name, shape in shapes.items()}
    states = {}
    for device in ("cpu", "cuda"):
        tensors = {name: each.clone().to(device).requires_grad_() for name, each in start.items()}
        moments = AdamState()
        draws = torch.Generator().manual_seed(9)
        for _ in range(50):
            gradients = {
                name: torch.randn(shape, generator=draws).to(device)
                for name, shape in shapes.items()
            }
            adam_step(tensors, gradients, moments, dict.fromkeys(shapes, 1e-2))
        states[device] = {name: each.detach().cpu() for name, each in tensors.items()}
    for name, expected in states["cpu"].items():
        torch.testing.assert_close(states["cuda"][name], expected, rtol=0, atol=2e-5)


def test_dropout_of_gaussians_is_sampled_on_the_device_and_repeatable():
    scene = random_gaussians(100_000, CAMERAS["middle"], opacities=(0.1, 0.2))
    rule = Dropout(share=0.3)
    found = []
    for _ in range(2):
        rngs = {"dropout": np.random.default_rng(4)}
        context = SimpleNamespace(gaussians=leaves(scene, "cuda", torch.float32), rngs=rngs)
        answers = [rule.crossgrad_view_gaussians(context) for _ in range(2)]
        found.append([each.gaussians.opacities.detach() for each in answers])
    (first, second), again = found
    assert torch.equal(first, again[0])
    assert torch.equal(second, again[1])
    assert not torch.equal(first, second)
    assert float((first == 0).float().mean()) == pytest.approx(0.3, abs=0.01)
    kept = first > 0
    torch.testing.assert_close(first[kept], scene.opacities.float().cuda()[kept] / 0.7)


def started(rasterizer, device="cuda", **options):
    config = {
        "steps": 200,
        "device": device,
        "rasterizer": rasterizer,
        "rules": {"dropout": False},  # A GPU leaves out others than the CPU.
        "metrics": [{"name": "psnr"}],
        **options,
    }
    setup = assemble(configured(config), sample_scene(), "none")
    return setup, begin(setup)


@pytest.mark.parametrize(
    "options",
    [
        {"densifier": {"name": "none"}},
        {"views_per_step": 2, "operator": {"name": "pcgrad"}},
        {"backbone": {"name": "distance"}, "rules": {"dropout": {}}},
    ],
    ids=str,
)
@pytest.mark.usefixtures("gsplat")
def test_a_regular_step_synchronizes_the_gpu_at_most_three_times(options):
    """A step reads the losses, and the Gramians or the check for finite gradients.

    gsplat synchronizes once more.
    """
    setup, state = started({"name": "gsplat"}, **options)
    for _ in range(5):
        timed_step(setup, state)
    torch.cuda.synchronize()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            timed_step(setup, state)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    waits = [f"{w.filename}:{w.lineno}" for w in found if "synchronizing CUDA" in str(w.message)]
    assert len(waits) <= 3, waits


def test_steps_along_the_axes_of_gaussians_agree_between_gpu_and_cpu():
    draws = torch.Generator().manual_seed(0)
    arrays = [torch.randn(5000, columns, generator=draws) for columns in (3, 3, 3, 4)]
    on_gpu = [each.to("cuda") for each in arrays]
    step_along_axes(*arrays)
    step_along_axes(*on_gpu)
    assert torch.allclose(on_gpu[0].cpu(), arrays[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backbone", ["vanilla", "scaffold"])
@pytest.mark.usefixtures("gsplat")
def test_floaters_agree_between_gpu_and_cpu(backbone):
    """Place primitives beside and behind the cameras. Compare the states after the removal."""
    options = {"backbone": {"name": backbone}}
    if backbone == "scaffold":
        options["backbone"]["voxel_size"] = 1e-2
    found = {}
    for device, rasterizer in (("cuda", "gsplat"), ("cpu", "torch")):
        setup, state = started({"name": rasterizer}, device, **options)
        positions = state.parameters[setup.backbone.positions].detach()
        centers = torch.stack([view.camera.center for view in setup.train_views])
        draws = torch.Generator().manual_seed(3)
        rows = torch.arange(0, len(positions), 2)
        moved = centers[rows % len(centers)]
        moved = moved + 0.1 * torch.randn(len(rows), 3, generator=draws, dtype=moved.dtype)
        positions[rows.to(device)] = moved.to(positions)
        (removal,) = final_edits(setup, state)
        left = removal.edit.source
        assert left.device.type == device
        assert len(state.parameters[setup.backbone.positions]) == len(left)
        timed_step(setup, state)
        found[device] = left.cpu()
    assert 0 < len(found["cpu"]) < len(positions)
    # A box that just reaches a photo counts as seen by gsplat, and may not by our rules.
    apart = set(found["cuda"].tolist()) ^ set(found["cpu"].tolist())
    assert len(apart) <= 0.02 * len(positions) + 1, apart


@pytest.mark.parametrize("backbone", ["vanilla", "pixel", "mip", "distance", "scaffold", "octree"])
@pytest.mark.parametrize("operator", ["sum", "pcgrad"])
def test_every_backbone_trains_alike_on_gpu_and_cpu(name, backbone, operator):
    """Train without growth, because growth uses random numbers and changes the order of rows."""
    if name == "gswarp" and backbone in {"mip", "pixel"}:
        pytest.skip("refused: docs/rasterizers.md")
    options = {
        "views_per_step": 2,
        "operator": {"name": operator},
        "backbone": {"name": backbone},
        "densifier": {"name": "none"},
    }
    if backbone == "scaffold":
        options["backbone"]["voxel_size"] = 1e-2
    losses = {}
    for device, rasterizer in (("cuda", {"name": name}), ("cpu", {"name": "torch", **ALIKE[name]})):
        setup, state = started(rasterizer, device, **options)
        losses[device] = torch.tensor([timed_step(setup, state).losses for _ in range(60)])
        assert all(each.isfinite().all() for each in state.tensors.values())
    apart = (losses["cuda"] - losses["cpu"]).abs() / losses["cpu"].mean()
    # Rounding takes runs apart in the end, sooner where a network or a threshold chooses.
    assert apart[:8].max() <= 2e-3
    assert apart.mean() <= 3e-2
    assert losses["cuda"][-10:].mean() < losses["cuda"][:10].mean()
