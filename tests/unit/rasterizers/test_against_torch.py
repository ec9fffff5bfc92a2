"""Every other rasterizer that runs on a CPU, held against the float64 reference case by case.

The fast ones compute in float32. How far that may lead off is not guessed but measured: the
reference is drawn again from inputs (Gaussians and camera) that are off by a few roundings of
float32, and what that changes is what an algorithm in float32 can be asked for. Each row of each
result may differ by `ROUNDINGS` times the largest change that it sees in a few such draws.

A decision (touch, cap, stop) that a rounding could turn has no right answer in float32. So pixels
with a compared value within `MARGIN` of its threshold get no weight in the loss and are left out of
the comparison, and Gaussians that come so near to a rule of their own are not in the scene. Binned
directions know two more: of the edges of bins, and of the sign of a gradient near 0. Gaussians
with such a pixel are left out of their comparison.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.brute_force import trace
from support.brute_gradients import pixel_gradients, places
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.registry.entries import build, entries, load

REFERENCE = "torch"
OURS = [name for name, entry in entries("rasterizers").items() if entry.distribution == "crossgrad"]
FAST = [name for name in OURS if name != REFERENCE]
OUTPUTS = frozenset({"depth", "pixels", "abs_gradient", "directions", "count"})
BINNED = ("directions", "bin sums", "bin counts")
TENSORS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")
MARGIN = 2e-4
ROUNDING = 2.0**-23
ROUNDINGS = 8
DRAWS = 3


@dataclass(frozen=True)
class Case:
    """A scene, a camera, a background and the rasterizer's options."""

    gaussians: Gaussians
    camera: Camera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    options: dict[str, float] = field(default_factory=dict)


def case(number=50, size=(40, 28), *, background=(0.0, 0.0, 0.0), dilation=None, **changes):
    """A random case; `changes` are those of `random_gaussians`, or options of the rasterizer."""
    options = {k: changes.pop(k) for k in ("max_alpha", "near", "dilation") if k in changes}
    camera = posed_camera(*size, focal=changes.pop("focal", 40.0))
    gaussians = random_gaussians(number, camera, **changes)
    return Case(replace(gaussians, dilation=dilation), camera, background, options)


def changed(made, **tensors):
    """A case with some tensors of its Gaussians mapped by functions."""
    new = {name: change(getattr(made.gaussians, name)) for name, change in tensors.items()}
    return replace(made, gaussians=replace(made.gaussians, **new))


def behind(made):
    """The same case with every other Gaussian mirrored to behind the camera."""
    center = made.camera.center
    sign = torch.tensor([1.0, -1.0]).double().repeat(len(made.gaussians))[: len(made.gaussians)]
    return changed(made, means=lambda means: center + sign[:, None] * (means - center))


def far_from_the_origin(made):
    """The same case, 300 units away."""
    offset = torch.tensor([300.0, -200.0, 100.0]).double()
    pose = made.camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ offset
    made = replace(made, camera=replace(made.camera, world_to_camera=pose))
    return changed(made, means=lambda means: means + offset)


def scaled(made, factor):
    """The same case in other units of length."""
    pose = made.camera.world_to_camera.clone()
    pose[:3, 3] *= factor
    made = replace(made, camera=replace(made.camera, world_to_camera=pose))
    return changed(made, means=lambda x: x * factor, scales=lambda x: x * factor)


def truncated(made):
    """The same case at degree 1, whatever bands there are."""
    return replace(made, gaussians=replace(made.gaussians, sh_degree=1))


CASES = {
    "usual": lambda: case(120),
    "one": lambda: case(1, border=-0.3),
    "none": lambda: case(0, background=(0.1, 0.2, 0.3)),
    "one pixel": lambda: case(40, (1, 1), focal=2.0),
    "one row": lambda: case(40, (33, 1)),
    "one tile": lambda: case(40, (16, 16)),
    "one pixel more than a tile": lambda: case(40, (17, 17)),
    "no multiple of a tile": lambda: case(80, (37, 19)),
    "three tiles in a row": lambda: case(80, (150, 20), sigmas=(0.5, 30.0)),
    "three tiles in a row, antialiased": lambda: case(
        80, (150, 20), sigmas=(0.5, 30.0), response="antialiased"
    ),
    "three tiles in a row, analytic": lambda: case(
        80, (150, 20), sigmas=(0.5, 30.0), response="analytic"
    ),
    "background": lambda: case(background=(0.3, 1.7, -0.4)),
    "degree 0": lambda: case(sh_degree=0),
    "degree 1": lambda: case(sh_degree=1),
    "degree 2": lambda: case(sh_degree=2),
    "degree 3": lambda: case(sh_degree=3),
    "degree 1 of 16 bands": lambda: truncated(case(sh_degree=3)),
    "dark harmonics": lambda: changed(case(sh_degree=3), sh_dc=lambda dc: dc - 1.5),
    "opaque": lambda: changed(case(120), opacities=torch.ones_like),
    "opaque, high cap": lambda: changed(case(120, max_alpha=0.999), opacities=torch.ones_like),
    "faint": lambda: case(120, opacities=(0.0, 0.03)),
    "dense": lambda: case(250, (20, 14), sigmas=(1.0, 6.0), opacities=(0.3, 1.0)),
    "tiny": lambda: case(150, sigmas=(1e-3, 0.3)),
    "huge": lambda: case(sigmas=(50.0, 5000.0)),
    "needles": lambda: case(sigmas=(0.02, 200.0)),
    "flat": lambda: changed(case(), scales=lambda s: s * torch.tensor([1.0, 1.0, 0.0])),
    "near": lambda: case(depths=(1.5e-3, 0.05)),
    "near plane": lambda: case(depths=(0.1, 4.0), near=1.0),
    "far": lambda: case(depths=(1e3, 1e5)),
    "near and far": lambda: case(depths=(2e-3, 1e4), sigmas=(0.3, 30.0)),
    "off the image": lambda: case(120, border=3.0, sigmas=(2.0, 40.0)),
    "out of sight": lambda: changed(case(), means=lambda means: means + 1e4),
    "behind the camera": lambda: behind(case()),
    "far from the origin": lambda: far_from_the_origin(case()),
    "large units": lambda: scaled(case(), 1e6),
    "small units": lambda: scaled(case(near=1e-9), 1e-6),
    "long quaternions": lambda: changed(case(), quats=lambda quats: quats * 1e6),
    "short quaternions": lambda: changed(case(), quats=lambda quats: quats * 1e-6),
    "little dilation": lambda: case(dilation=0.1),
    "no dilation": lambda: case(dilation=0.0, sigmas=(0.5, 4.0)),
    "antialiased": lambda: case(120, response="antialiased", dilation=0.1),
    "antialiased, tiny": lambda: case(150, response="antialiased", sigmas=(0.02, 0.5)),
    "antialiased, needles": lambda: case(response="antialiased", sigmas=(0.02, 200.0)),
    "analytic": lambda: case(120, response="analytic"),
    "analytic, tiny": lambda: case(150, response="analytic", sigmas=(0.02, 0.5)),
    "analytic, huge": lambda: case(response="analytic", sigmas=(20.0, 300.0)),
    "analytic, needles": lambda: case(response="analytic", sigmas=(0.05, 50.0)),
}


def mapped(gaussians, change):
    """The Gaussians with every tensor mapped."""
    tensors = {name: getattr(gaussians, name) for name in TENSORS}
    return replace(gaussians, **{n: change(t) for n, t in tensors.items() if t is not None})


def settled(made):
    """The case in float32's numbers, without Gaussians on the verge of a rule; and its trace."""
    made = replace(made, gaussians=mapped(made.gaussians, lambda t: t.float().double()))
    while True:
        exact = trace(made.gaussians, made.camera, **made.options)
        keep = torch.from_numpy(exact.gaussian_gaps > MARGIN)
        if keep.all():
            return made, exact
        made = replace(made, gaussians=mapped(made.gaussians, lambda t, k=keep: t[k]))


def shaken(made, seed):
    """The case with every number off by up to two roundings of float32."""
    rng = torch.Generator().manual_seed(seed)

    def shake(tensor):
        noise = 2 * torch.rand(tensor.shape, generator=rng, dtype=torch.float64) - 1
        return tensor * (1 + 2 * ROUNDING * noise)

    camera = made.camera
    numbers = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    fx, fy, cx, cy = shake(numbers).tolist()
    pose = shake(camera.world_to_camera)
    camera = Camera(camera.width, camera.height, fx, fy, cx, cy, pose)
    return replace(made, gaussians=mapped(made.gaussians, shake), camera=camera)


def draw(name, made, weights, dtype, noise=None):
    """Name -> [rows, columns] float64 of all results and gradients; and the screen.

    What lies behind a Gaussian enters its gradient. An algorithm that does not keep every blend has
    it as the pixel's whole minus what lies in front: right to a rounding of the whole, not of
    itself. Where given, `noise` [H, W] has that effect: an error e in what is behind adds to the
    gradient by each alpha e / (1 - alpha), which is the gradient of e log(transmittance).
    """
    gaussians = mapped(made.gaussians, lambda t: t.detach().to(dtype, copy=True).requires_grad_())
    background = torch.tensor(made.background, dtype=dtype)
    rasterizer = build("rasterizers", name, made.options)
    result = rasterizer.render(gaussians, made.camera, background, OUTPUTS)
    images = {
        "image": result.image,
        "alpha": result.alpha[..., None],
        "depth": result.depth[..., None],
    }
    loss = sum((weights[key] * image).sum() for key, image in images.items())
    if noise is not None:
        whole = sum((weights[key] * image).detach().abs().sum(-1) for key, image in images.items())
        loss = loss + (noise * whole * (1 - result.alpha).log()).sum()
    loss.backward()
    tensors = {name: getattr(gaussians, name) for name in TENSORS}
    found = {n: t.grad[:, None].flatten(1) for n, t in tensors.items() if t is not None}
    found |= {key: (image * (weights[key] != 0)).flatten(0, 1) for key, image in images.items()}
    found |= {"mean_gradient": result.screen.mean_gradient}
    found |= {"abs_gradient": result.screen.abs_gradient}
    bins = result.screen.directions.split([2, 2, 1], -1)
    found |= {key: rows.flatten(1) for key, rows in zip(BINNED, bins, strict=True)}
    return {key: value.detach().double() for key, value in found.items()}, result.screen


def weighting(made, unsettled):
    """Random weights of image, alpha and depth; none where a rounding could turn a decision."""
    rng = torch.Generator().manual_seed(3)
    shape = (made.camera.height, made.camera.width)
    settled_pixels = torch.from_numpy(~unsettled)[..., None]
    channels = {"image": 3, "alpha": 1, "depth": 1}
    return {
        key: torch.randn(*shape, count, generator=rng, dtype=torch.float64) * settled_pixels
        for key, count in channels.items()
    }


def drawn_shaken(made, weights, seed):
    """Results of the reference with every number off by a few roundings."""
    rng = torch.Generator().manual_seed(seed)
    size = (made.camera.height, made.camera.width)
    noise = 2 * ROUNDING * (2 * torch.rand(size, generator=rng, dtype=torch.float64) - 1)
    return draw(REFERENCE, shaken(made, seed), weights, torch.float64, noise)[0]


def decided(made, weights, drawn):
    """[N] bool: no rounding can move a pixel to another bin or turn its gradient around."""
    options = {**made.options, "background": made.background}
    exact = pixel_gradients(made.gaussians, made.camera, weights=weights, drawn=drawn, **options)
    shakes = [shaken(made, seed) for seed in range(DRAWS)]
    along = [places(shake.gaussians, shake.camera) for shake in shakes]
    moved = np.max([np.abs(each - exact.along) for each in along], axis=0)
    gaps = np.min([np.abs(exact.along - edge) for edge in (-2, -1, 0, 1, 2)], axis=0)
    some = exact.gradients.any(-1)
    sure = gaps > ROUNDINGS * (moved + ROUNDING * np.abs(exact.along))
    # An axis seen end on has every pixel in one bin, and nothing to move.
    sure |= (exact.along == 0).all((1, 2), keepdims=True) & (moved == 0)
    return torch.from_numpy((~some | (sure & (exact.doubt * MARGIN < 1))).all((1, 2)))


@pytest.fixture(params=FAST)
def name(request):
    if "cpu" not in load("rasterizers", request.param).devices:
        pytest.skip(f"{request.param} does not run on a CPU")
    return request.param


@pytest.mark.sampled(23)
@pytest.mark.parametrize("case_name", CASES)
def test_each_rasterizer_agrees_with_the_reference(name, case_name):
    made, exact = settled(CASES[case_name]())
    unsettled = exact.pixel_gaps <= MARGIN
    weights = weighting(made, unsettled)
    expected, screen = draw(REFERENCE, made, weights, torch.float64)
    found, fast = draw(name, made, weights, torch.float32)
    shakes = [drawn_shaken(made, weights, seed) for seed in range(DRAWS)]
    binned = decided(made, weights, exact)
    assert binned.float().mean() > 0.5 or not len(binned)
    counts = expected["bin counts"].sum(-1)
    for key, rows in expected.items():
        change = torch.stack([(s[key] - rows).norm(dim=-1) for s in shakes]).amax(0)
        # alpha is 1 - transmittance: no better than a rounding of 1. Directions are of length 1.
        sizes = {"alpha": torch.ones(len(rows)), "directions": counts}
        limit = ROUNDINGS * (change + ROUNDING * sizes.get(key, rows.norm(dim=-1)))
        error = (found[key] - rows).norm(dim=-1)
        if key in BINNED:
            error = torch.where(binned, error, 0.0)
        worst = error / limit.clamp(min=1e-300)
        assert (error <= limit).all(), f"{key}: {worst.amax():.3g} times what is allowed"
    assert_same_footprints(screen, fast, exact, unsettled)
    assert_same_counts(screen, fast, exact, unsettled)


def test_gaussians_of_equal_depth_are_drawn_in_the_order_of_rows(name):
    made, _ = settled(case(30))
    # Every Gaussian a second time at the same place, but the last of the first round is the first
    # of the second in colour and opacity: another order of equal depths is another image.
    twice = mapped(made.gaussians, lambda t: torch.cat([t, t]))
    twice = replace(twice, colors=twice.colors.flip(0), opacities=twice.opacities.flip(0))
    made = replace(made, gaussians=twice)
    weights = weighting(made, trace(twice, made.camera).pixel_gaps <= MARGIN)
    expected, _ = draw(REFERENCE, made, weights, torch.float64)
    found, _ = draw(name, made, weights, torch.float32)
    for key, rows in expected.items():
        if key in BINNED:
            continue  # of gradients near 0 the direction is a matter of rounding
        # Far above the roundings of this scene and far below another order.
        assert (found[key] - rows).norm() <= 1e-4 * rows.norm(), key


def assert_same_footprints(screen, fast, exact, unsettled):
    """Radii and pixels are equal except where a rounding decides."""
    # Number of unsettled pixels in which each Gaussian may or may not be drawn.
    slack = ((exact.raw > (1 - MARGIN) / 255) & unsettled).sum((1, 2))
    pixels = (screen.pixels - fast.pixels).abs().numpy()
    assert (pixels <= slack).all()
    radii, found = screen.radii.numpy(), fast.radii.numpy()
    at_whole_pixel = np.abs(exact.extents - np.rint(exact.extents)) <= MARGIN * exact.extents
    vanished = (slack > 0) & (np.minimum(radii, found) == 0)
    assert np.all((radii == found) | vanished | ((np.abs(radii - found) == 1) & at_whole_pixel))


def assert_same_counts(screen, fast, exact, unsettled):
    """Marked pixels are counted exactly, also against brute force; a rounding may turn others."""
    for density in (0.0, 0.02, 0.4, 1.0):
        marked = np.random.default_rng(5).random(unsettled.shape) < density
        sure = torch.from_numpy(marked & ~unsettled)
        expected = torch.from_numpy(exact.blended[:, sure.numpy()].sum(1)).int()
        assert torch.equal(screen.count(sure), expected)
        assert torch.equal(fast.count(sure), expected)
        whole = torch.from_numpy(marked)
        slack = ((exact.raw > (1 - MARGIN) / 255) & unsettled & marked).sum((1, 2))
        assert ((screen.count(whole) - fast.count(whole)).abs().numpy() <= slack).all()
    assert torch.equal(screen.count(whole), screen.pixels)
    assert torch.equal(fast.count(whole), fast.pixels)


@given(
    seed=st.integers(0, 2**20),
    response=st.sampled_from(["plain", "antialiased", "analytic"]),
    size=st.tuples(st.integers(1, 140), st.integers(1, 40)),
    sigmas=st.sampled_from([(1e-3, 0.5), (0.5, 5.0), (0.05, 100.0)]),
    density=st.floats(0.0, 1.0),
)
@settings(deadline=None, max_examples=25)
def test_marked_pixels_of_random_views_are_counted_exactly(seed, response, size, sigmas, density):
    made, exact = settled(case(25, size, seed=seed, response=response, sigmas=sigmas))
    marked = np.random.default_rng(seed).random(exact.pixel_gaps.shape) < density
    marked = torch.from_numpy(marked & (exact.pixel_gaps > MARGIN))
    expected = torch.from_numpy(exact.blended[:, marked.numpy()].sum(1)).int()
    for name, dtype in (("numba", torch.float32), (REFERENCE, torch.float64)):
        gaussians = mapped(made.gaussians, lambda tensor, dtype=dtype: tensor.to(dtype))
        background = torch.zeros(3, dtype=dtype)
        rasterizer = build("rasterizers", name, made.options)
        render = rasterizer.render(gaussians, made.camera, background, frozenset({"count"}))
        assert torch.equal(render.screen.count(marked), expected), name


@pytest.mark.sampled(37)
@pytest.mark.parametrize(
    ("tensor", "value"),
    [
        ("means", float("nan")),
        ("means", float("inf")),
        ("means", -1e30),
        ("quats", 0.0),
        ("quats", float("nan")),
        ("scales", float("inf")),
        ("scales", float("nan")),
        ("opacities", 0.0039),
        ("opacities", float("nan")),
        ("opacities", float("inf")),
        ("colors", float("nan")),
        ("colors", float("inf")),
    ],
)
@pytest.mark.parametrize("response", ["plain", "antialiased", "analytic"])
def test_a_gaussian_that_cannot_be_rendered_does_not_change_the_image(
    name, response, tensor, value
):
    made, _ = settled(case(20, response=response))
    getattr(made.gaussians, tensor)[3] = value
    others = torch.arange(20) != 3
    without = replace(made, gaussians=mapped(made.gaussians, lambda t: t[others]))
    weights = weighting(made, np.zeros((made.camera.height, made.camera.width), bool))
    found, screen = draw(name, made, weights, torch.float32)
    expected, _ = draw(name, without, weights, torch.float32)
    for key, rows in expected.items():
        if len(found[key]) == len(rows):
            assert torch.equal(found[key], rows), key
        else:
            assert torch.equal(found[key][others], rows), key
            assert (found[key][3] == 0).all(), key
    assert screen.radii[3] == 0


@pytest.mark.parametrize("size", [5e5, 1e6, 1e7])
def test_gaussians_that_cover_the_world_have_the_largest_radius(name, size):
    camera = Camera(64, 48, 1000.0, 1000.0, 32.0, 24.0, torch.eye(4, dtype=torch.float64))
    one = Gaussians(
        means=torch.tensor([[0.0, 0.0, 1.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), size),
        opacities=torch.tensor([0.5]),
        colors=torch.ones(1, 3),
    )
    for rasterizer in (name, "torch"):
        screen = build("rasterizers", rasterizer, {}).render(one, camera, torch.zeros(3)).screen
        assert screen.radii.tolist() == [2**30], rasterizer


def test_the_default_rasterizer_is_compared_with_the_reference():
    assert "numba" in FAST
