"""The CPU kernels as arrays: closed forms, a float64 restatement in NumPy, bits, extremes."""

import math
from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest

from crossgrad_core.numerics import jobs
from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import parallel
from crossgrad_plugins.rasterizers.numba_kernels.arrays import (
    CameraArrays,
    DrawOptions,
    GaussianArrays,
    in_lines,
)
from crossgrad_plugins.rasterizers.numba_kernels.frame import backward, forward
from crossgrad_plugins.rasterizers.numba_kernels.layout import CHUNK, RECORD, RED
from crossgrad_plugins.rasterizers.numba_kernels.records import log2_of
from crossgrad_plugins.rasterizers.numba_kernels.sorting import order_by_depth
from crossgrad_plugins.rasterizers.numba_kernels.spherical_harmonics import sh_forward

BLACK = np.zeros(3, np.float32)
FOCAL = 100.0
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


def camera(width, height, viewmat=None):
    intrinsics = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1.0]])
    return CameraArrays(np.eye(4) if viewmat is None else viewmat, intrinsics, width, height)


def splats(pixels, depths, sigmas, opacities, colors, size):
    """Round Gaussians at pixel positions with a standard deviation in pixels, before dilation."""
    pixels, depths, sigmas = (np.asarray(values, float) for values in (pixels, depths, sigmas))
    offsets = (pixels - np.array(size) / 2) * depths[:, None] / FOCAL
    count = len(depths)
    return GaussianArrays(
        means=np.concatenate([offsets, depths[:, None]], 1).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.repeat((sigmas * depths / FOCAL)[:, None], 3, 1).astype(np.float32),
        opacities=np.asarray(opacities, np.float32),
        colors=np.asarray(colors, np.float32),
    )


def cloud(count, size, seed=0, opacities=(0.1, 0.95), sigmas=(0.5, 6.0)):
    """Random Gaussians of any shape on and around the image."""
    rng = np.random.default_rng(seed)
    depths = rng.uniform(1.0, 3.0, count)
    pixels = rng.uniform(-0.2, 1.2, (count, 2)) * size
    opacity = rng.uniform(*opacities, count)
    found = splats(pixels, depths, np.ones(count), opacity, rng.uniform(0, 1, (count, 3)), size)
    scales = np.exp(rng.uniform(*np.log(sigmas), (count, 3))) * depths[:, None] / FOCAL
    quats = rng.normal(size=(count, 4))
    return replace(found, scales=scales.astype(np.float32), quats=quats.astype(np.float32))


def footprints(gaussians, view, options):
    """float64: means [N, 2], covariances [N, 2, 2] (dilated) and depths [N]."""
    means, scales = gaussians.means.astype(float), gaussians.scales.astype(float)
    x, y, z = (means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
    (fx, _, cx), (_, fy, cy), _ = view.intrinsics
    margin_x, margin_y = 0.15 * view.width / fx, 0.15 * view.height / fy
    slope_x = np.clip(x / z, -cx / fx - margin_x, (view.width - cx) / fx + margin_x)
    slope_y = np.clip(y / z, -cy / fy - margin_y, (view.height - cy) / fy + margin_y)
    zero = np.zeros_like(z)
    jacobian = np.array([[fx / z, zero, -fx * slope_x / z], [zero, fy / z, -fy * slope_y / z]])
    quats = gaussians.quats.astype(float)
    w, a, b, c = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rotations = np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )
    factor = np.einsum("uin,ij,jkn->nuk", jacobian, view.viewmat[:3, :3], rotations)
    factor = factor * scales[:, None, :]
    covariances = factor @ factor.transpose(0, 2, 1) + options.dilation * np.eye(2)
    return np.stack([fx * x / z + cx, fy * y / z + cy], 1), covariances, z


def restated(gaussians, view, options, background=BLACK):
    """float64 image, alpha, depth, pixels blended [N] and pixels touched [N]."""
    means, covariances, depths = footprints(gaussians, view, options)
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    through = np.ones(columns.shape)
    going = np.ones(columns.shape, bool)
    image, depth = np.zeros((*columns.shape, 3)), np.zeros(columns.shape)
    blended, touched = np.zeros(len(depths), int), np.zeros(len(depths), int)
    for i in np.argsort(depths, kind="stable"):
        if depths[i] <= options.near or gaussians.opacities[i] < 1 / 255:
            continue
        offset = np.stack([columns - means[i, 0], rows - means[i, 1]], -1)
        power = -0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariances[i]), offset)
        alpha = np.minimum(options.max_alpha, float(gaussians.opacities[i]) * np.exp(power))
        touches = alpha >= 1 / 255
        going &= ~(touches & (through * (1 - alpha) < 1e-4))
        alpha = np.where(touches & going, alpha, 0.0)
        image += (alpha * through)[..., None] * gaussians.colors[i].astype(float)
        depth += alpha * through * depths[i]
        through = through * (1 - alpha)
        blended[i], touched[i] = (touches & going).sum(), touches.sum()
    return image + through[..., None] * background, 1 - through, depth, blended, touched


#: All optional outputs. Each combination is a kernel of its own to compile, so few are used here.
EVERYTHING = {"depth": True, "pixels": True}


def drawn(gaussians, view, background=BLACK, **options):
    return forward(gaussians, view, background, DrawOptions(**options))


def test_a_gaussian_has_its_opacity_at_its_centre_and_decays_with_the_dilated_variance():
    one = splats([(20.5, 11.5)], [2.0], [1.5], [0.7], [(0.2, 0.4, 1.0)], (41, 23))
    frame = drawn(one, camera(41, 23), dilation=0.3)
    variance = 1.5**2 + 0.3
    for shift in (0, 1, 2, 3):
        expected = 0.7 * np.exp(-0.5 * shift**2 / variance)
        for pixel in ((11, 20 + shift), (11, 20 - shift), (11 + shift, 20), (11 - shift, 20)):
            assert frame.alpha[pixel] == pytest.approx(expected, rel=1e-5)
            np.testing.assert_allclose(frame.image[pixel], expected * one.colors[0], rtol=1e-5)
    radius = np.sqrt(2 * np.log(0.7 * 255) * variance)
    assert frame.projected.radii.tolist() == [int(np.ceil(radius))]


@pytest.mark.parametrize("first", [0, 1])
def test_the_nearer_gaussian_covers_the_farther_gaussian_by_its_alpha(first):
    depths = [1.0, 2.0] if first == 0 else [2.0, 1.0]
    colors = np.array([(1.0, 0.0, 0.25), (0.0, 1.0, 0.5)])
    opacities = np.array([0.6, 0.5])
    two = splats([(8.5, 8.5)] * 2, depths, [2.0, 2.0], opacities, colors, (16, 16))
    frame = drawn(
        two, camera(16, 16), background=np.array([0.5, 1.0, 2.0], np.float32), **EVERYTHING
    )
    near, far = first, 1 - first
    expected = opacities[near] * colors[near]
    behind = 1 - opacities[near]
    expected = expected + behind * opacities[far] * colors[far]
    rest = behind * (1 - opacities[far])
    np.testing.assert_allclose(frame.image[8, 8], expected + rest * np.array([0.5, 1, 2]), 1e-5)
    assert frame.alpha[8, 8] == pytest.approx(1 - rest, rel=1e-5)
    assert frame.depth[8, 8] == pytest.approx(
        opacities[near] + 2 * behind * opacities[far], rel=1e-5
    )


def test_gaussians_of_equal_depth_are_drawn_in_the_order_of_the_input():
    two = splats([(8.5, 8.5)] * 2, [1.5, 1.5], [2.0] * 2, [0.9, 0.9], np.eye(3)[:2], (16, 16))
    assert drawn(two, camera(16, 16)).image[8, 8, 0] == pytest.approx(0.9, rel=1e-5)


def test_a_capped_alpha_has_no_gradient_but_its_colour_has_a_gradient():
    one = splats([(8.5, 8.5)], [1.0], [300.0], [1.0], [(0.5, 0.5, 0.5)], (16, 16))
    frame = drawn(one, camera(16, 16), max_alpha=0.8)
    np.testing.assert_allclose(frame.alpha, 0.8, rtol=1e-6)
    gradients = backward(frame, np.ones((16, 16, 3), np.float32))
    for name in ("means", "quats", "scales", "opacities", "centres"):
        assert not getattr(gradients, name).any(), name
    np.testing.assert_allclose(gradients.colors, 0.8 * 256, rtol=1e-5)


def test_compositing_stops_before_the_transmittance_falls_below_the_limit():
    count = 5  # 0.9 each: 0.1, 0.01, 0.001 go through; the fourth would leave 1e-4 (1 - 4e-4)
    many = splats(
        [(4.5, 4.5)] * count, np.arange(1.0, 1.0 + count), [1e5] * count, [0.9001] * count,
        np.ones((count, 3)), (9, 9),
    )  # fmt: skip
    frame = drawn(many, camera(9, 9), **EVERYTHING)
    assert frame.pixels.tolist() == [81, 81, 81, 0, 0]
    np.testing.assert_allclose(frame.alpha, 1 - (1 - 0.9001) ** 3, rtol=1e-6)
    gradients = backward(frame, np.ones((9, 9, 3), np.float32))
    assert (gradients.colors[:3] > 0).all()
    assert not gradients.colors[3:].any()


SIZES = [
    (1, 1),
    (7, 9),
    (8, 8),
    (9, 8),
    (16, 16),
    (17, 15),
    (32, 16),
    (33, 17),
    (70, 35),
    (150, 20),
]


@pytest.mark.parametrize("size", SIZES)
def test_images_of_any_size_agree_with_the_numpy_version(size):
    gaussians, view, options = cloud(60, size), camera(*size), DrawOptions(**EVERYTHING)
    background = np.array([0.3, 0.6, 0.1], np.float32)
    frame = forward(gaussians, view, background, options)
    image, alpha, depth, blended, touched = restated(gaussians, view, options, background)
    np.testing.assert_allclose(frame.image, image, atol=3e-6)
    np.testing.assert_allclose(frame.alpha, alpha, atol=3e-6)
    np.testing.assert_allclose(frame.depth, depth, atol=1e-5)
    np.testing.assert_array_equal(frame.pixels, blended)
    np.testing.assert_array_equal(frame.projected.radii > 0, touched > 0)


@pytest.mark.parametrize("x", [15.4, 15.5, 16.0, 31.6, 32.0, 32.5, 63.4, 63.5, 64.0, 64.5])
@pytest.mark.parametrize("y", [7.9, 8.0, 15.5, 16.0, 16.4])
def test_footprints_continue_across_patches_and_tiles_without_a_seam(x, y):
    size = (80, 32)
    one = splats([(x, y)], [1.0], [0.9], [0.8], [(1.0, 1.0, 1.0)], size)
    options = DrawOptions(**EVERYTHING)
    frame = forward(one, camera(*size), BLACK, options)
    image, _, _, blended, _ = restated(one, camera(*size), options)
    np.testing.assert_allclose(frame.image, image, atol=1e-6)
    assert frame.pixels.tolist() == blended.tolist()


def weights(size, seed=1):
    rng = np.random.default_rng(seed)
    shape = size[::-1]
    return [rng.normal(size=s).astype(np.float32) for s in ((*shape, 3), shape, shape)]


def difference_quotient(gaussians, view, options, v, number, step=1e-5):
    """Central difference of the restated loss by one number (name, index) of a parameter."""
    name, index = number
    losses = []
    for sign in (1.0, -1.0):
        values = getattr(gaussians, name).astype(float)
        values[index] += sign * step
        image, alpha, depth, *_ = restated(replace(gaussians, **{name: values}), view, options)
        losses.append((image * v[0]).sum() + (alpha * v[1]).sum() + (depth * v[2]).sum())
    return (losses[0] - losses[1]) / (2 * step)


@pytest.mark.parametrize("name", PARAMETERS)
def test_gradients_agree_with_finite_differences(name):
    size = (24, 20)
    # Faint and wide, so that no pixel is near a threshold that a step could cross.
    gaussians = cloud(3, size, seed=4, opacities=(0.3, 0.6), sigmas=(40.0, 90.0))
    turn = np.array([[0.8, -0.6, 0.0, 0.1], [0.6, 0.8, 0.0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
    view, options, v = camera(*size, viewmat=turn), DrawOptions(**EVERYTHING), weights(size)
    gradients = getattr(backward(forward(gaussians, view, BLACK, options), *v, absolute=True), name)
    for index in np.ndindex(gradients.shape):
        expected = difference_quotient(gaussians, view, options, v, (name, index))
        assert gradients[index] == pytest.approx(expected, rel=2e-4, abs=2e-3), index


def test_absolute_gradients_are_sums_of_absolute_gradients_over_pixels():
    size = (18, 9)
    gaussians = cloud(6, size, seed=2)
    frame = drawn(gaussians, camera(*size))
    v_image = weights(size)[0]
    total = np.zeros((6, 2))
    signed = np.zeros((6, 2))
    for pixel in np.ndindex(size[::-1]):
        only = np.zeros_like(v_image)
        only[pixel] = v_image[pixel]
        centres = backward(frame, only).centres
        total += np.abs(centres)
        signed += centres
    gradients = backward(frame, v_image, absolute=True)
    np.testing.assert_allclose(gradients.absolute, total, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gradients.centres, signed, rtol=1e-4, atol=1e-4)


def test_requesting_optional_outputs_changes_no_gradient():
    size = (40, 30)
    gaussians, v = cloud(80, size), weights(size)
    plain = backward(drawn(gaussians, camera(*size)), v[0])
    frame = drawn(gaussians, camera(*size), **EVERYTHING)
    zero = np.zeros_like(v[1])
    found = backward(frame, v[0], zero, zero, absolute=True)
    for name in (*PARAMETERS, "centres"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name), name)


@pytest.mark.parametrize("response", ["plain", "antialiased", "analytic"])
@pytest.mark.parametrize("count", [1, 40, 5000])
def test_reused_memory_changes_no_gradient(monkeypatch, count, response):
    """Test rendered Gaussians and Gaussians outside the image."""
    size, view = (40, 24), camera(40, 24)
    gaussians = cloud(count, size)
    gaussians.means[::2, 0] += 1000.0
    frame = forward(gaussians, view, BLACK, DrawOptions(response=response))
    v_image, v_alpha, _ = weights(size)
    found = [backward(frame, v_image, v_alpha, absolute=True)]
    with monkeypatch.context() as patch:
        patch.setattr(np, "empty", lambda shape, kind: np.full(shape, np.nan, kind))
        found.append(backward(frame, v_image, v_alpha, absolute=True))
    for name in ("means", "quats", "scales", "opacities", "colors", "centres", "absolute"):
        first, second = (getattr(each, name) for each in found)
        np.testing.assert_array_equal(first, second)
        assert np.isfinite(first).all()


def harmonics(count, degree, seed=0):
    rng = np.random.default_rng(seed)
    dc = rng.normal(size=(count, 1, 3)).astype(np.float32)
    rest = rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    return dc, 0.3 * rest


def test_degree_0_gives_one_half_plus_the_constant_harmonic_clamped_at_zero():
    one = splats([(8.5, 8.5)], [1.0], [3.0], [0.5], [(0.0, 0.0, 0.0)], (16, 16))
    dc = np.array([[[1.0, -5.0, 0.2]]], np.float32)
    one = replace(one, colors=None, dc=dc, rest=np.empty((1, 0, 3), np.float32))
    frame = drawn(one, camera(16, 16))
    expected = 0.5 * np.array([0.5 + 0.28209479, 0.0, 0.5 + 0.28209479 * 0.2])
    np.testing.assert_allclose(frame.image[8, 8], expected, rtol=1e-5)
    gradients = backward(frame, np.ones((16, 16, 3), np.float32))
    assert (gradients.dc[0, 0] != 0).tolist() == [True, False, True]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradients_of_harmonics_agree_with_finite_differences(degree):
    size = (12, 10)
    base = cloud(2, size, seed=5, opacities=(0.4, 0.6), sigmas=(60.0, 90.0))
    dc, rest = harmonics(2, 3)
    gaussians = replace(base, colors=None, dc=dc, rest=rest, degree=degree)
    view, v_image = camera(*size), weights(size)[0]
    found = backward(forward(gaussians, view, BLACK, DrawOptions()), v_image)
    assert not found.rest[:, (degree + 1) ** 2 - 1 :].any()

    def loss(changed):
        image = forward(changed, view, BLACK, DrawOptions()).image
        return float((image.astype(float) * v_image).sum())

    for name, index in (("dc", (0, 0, 1)), ("rest", (1, 2, 0)), ("rest", (0, 0, 2))):
        step = np.float32(0.05)
        losses = []
        for sign in (1, -1):
            values = getattr(gaussians, name).copy()
            values[index] += sign * step
            losses.append(loss(replace(gaussians, **{name: values})))
        expected = (losses[0] - losses[1]) / (2 * step)
        assert getattr(found, name)[index] == pytest.approx(expected, rel=2e-2, abs=2e-3)


@pytest.mark.parametrize("rows", [frozenset(), frozenset({"sh_dc", "sh_rest"})], ids=len)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_omitting_gradients_of_sh_changes_no_other_gradient(degree, rows):
    size = (40, 30)
    dc, rest = harmonics(200, 3)
    base = cloud(200, size, seed=6)
    given = replace(base, colors=None, dc=dc, rest=rest, degree=degree, sparse_rows=rows)
    frame = forward(
        replace(given, bring=lambda _: None), camera(*size), BLACK, DrawOptions(max_alpha=0.999)
    )
    v_image = weights(size)[0]
    whole, some = backward(frame, v_image), backward(frame, v_image, harmonics=False)
    assert some.rest is None and whole.rest.any() == (degree > 0)
    for name in ("means", "quats", "scales", "opacities", "dc", "centres"):
        assert getattr(whole, name).any()
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name))


@kernel
def _logarithms(values, found):
    for k in range(len(values)):
        found[k] = log2_of(values[k])


def test_the_logarithm_of_opacities_is_accurate_to_float32():
    rng = np.random.default_rng(0)
    values = np.concatenate([2.0 ** rng.uniform(-1000, 3, 3000), 2.0 ** rng.uniform(-8, 0, 3000)])
    values = np.array([*values, 1.0, 0.5, 1.0 / 255.0, np.nextafter(1.0, 0.0), math.sqrt(2.0), 0.0])
    found = np.empty_like(values)
    _logarithms(values, found)
    np.testing.assert_allclose(found[:-1], np.log2(values[:-1]), rtol=1e-15, atol=1e-13)
    assert found[-1] < -1000.0


def test_the_harmonics_are_orthonormal_on_the_sphere():
    # The mean over random directions of each product of two basis functions.
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = np.stack([basis_values(directions, k) for k in range(16)], 1)
    gram = 4 * np.pi * values.T @ values / len(directions)
    np.testing.assert_allclose(gram, np.eye(16), atol=0.15)


def basis_values(directions, k):
    """Basis function k along unit vectors, read off the gradient of its coefficient."""
    count = len(directions)
    chunks = -(-count // CHUNK)
    dc, rest = np.zeros((count, 1, 3), np.float32), np.zeros((count, 15, 3), np.float32)
    if k == 0:
        dc[:] = 0.1
    else:
        rest[:, k - 1] = 0.1
    records = np.zeros(count * RECORD, np.float32)
    sizes = np.array([min(CHUNK, count - chunk * CHUNK) for chunk in range(chunks)])
    parallel(
        sh_forward,
        3, np.zeros(3), directions.astype(np.float32), dc, rest, sizes,
        np.arange(count, dtype=np.int32), records, np.ones(count, np.int32),
    )  # fmt: skip
    return (records.reshape(count, RECORD)[:, RED] - 0.5) / 0.1


def same_bits(first, second):
    for name in (*PARAMETERS, "centres", "absolute", "directions"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), name)


@pytest.mark.parametrize("threads", [1, 2])
def test_bits_do_not_depend_on_the_number_of_threads_or_the_run(threads):
    if threads > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("fewer threads here")
    size = (150, 90)
    gaussians, v_image = cloud(6000, size), weights(size)[0]

    def run():
        frame = drawn(gaussians, camera(*size), **EVERYTHING)
        return frame, backward(frame, v_image, absolute=True, directions=True)

    before = numba.get_num_threads()
    frame, gradients = run()
    try:
        numba.set_num_threads(threads)
        again, gradients_again = run()
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(frame.image, again.image)
    np.testing.assert_array_equal(frame.pixels, again.pixels)
    same_bits(gradients, gradients_again)


@pytest.mark.parametrize("threads", [2, 3, 17])
def test_bits_do_not_depend_on_the_thread_that_does_a_job(threads, monkeypatch):
    size = (150, 90)
    gaussians, v_image = cloud(6000, size), weights(size)[0]
    found = []
    of_threads = jobs._jobs
    for first in (0, threads - 1):
        # As if one of the threads did all of them, from its own ones on.
        monkeypatch.setattr(jobs, "_jobs", lambda _, first=first: [of_threads(threads)[first]])
        frame = drawn(gaussians, camera(*size), **EVERYTHING)
        found.append((frame, backward(frame, v_image, absolute=True, directions=True)))
    (frame, gradients), (again, gradients_again) = found
    np.testing.assert_array_equal(frame.image, again.image)
    np.testing.assert_array_equal(frame.pixels, again.pixels)
    same_bits(gradients, gradients_again)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 1_000_000])
def test_rows_of_sixteen_numbers_fill_cache_lines(count):
    room = in_lines(count)
    assert room.shape == (count,) and room.dtype == np.float32
    assert count == 0 or room.ctypes.data % 64 == 0


def test_two_rendered_frames_can_exist_at_the_same_time():
    size = (40, 30)
    first, second = cloud(50, size, seed=1), cloud(70, size, seed=2)
    v_image = weights(size)[0]
    alone = backward(drawn(first, camera(*size)), v_image, absolute=True)
    frame = drawn(first, camera(*size))
    backward(drawn(second, camera(*size)), v_image)
    same_bits(alone, backward(frame, v_image, absolute=True))


def test_a_view_without_visible_gaussians_gives_the_background():
    empty = cloud(0, (8, 8))
    behind = replace(cloud(5, (8, 8)), means=np.full((5, 3), -3.0, np.float32))
    background = np.array([0.1, 0.2, 0.3], np.float32)
    for gaussians in (empty, behind):
        frame = drawn(gaussians, camera(8, 8), background, **EVERYTHING)
        np.testing.assert_array_equal(frame.image, np.broadcast_to(background, (8, 8, 3)))
        assert not frame.alpha.any()
        gradients = backward(frame, *weights((8, 8)), absolute=True)
        assert all(not getattr(gradients, name).any() for name in (*PARAMETERS, "absolute"))


@pytest.mark.parametrize("response", ["plain", "antialiased", "analytic"])
def test_extreme_inputs_give_finite_results(response):
    rng = np.random.default_rng(7)
    size, count = (37, 21), 4000
    gaussians = cloud(count, size)
    extremes = np.array([1e-38, 1e-12, 1e-3, 1.0, 1e6, 1e20, 1e38])
    scales = rng.choice(extremes, (count, 3)).astype(np.float32)
    scales[: count // 2] = gaussians.scales[: count // 2]
    means = gaussians.means.copy()
    means[::3] *= rng.choice(np.array([1e-6, 1e3, 1e10, 1e30], np.float32), (len(means[::3]), 1))
    quats = gaussians.quats * rng.choice(np.array([0.0, 1e-15, 1.0, 1e15], np.float32), (count, 1))
    gaussians = replace(gaussians, means=means, scales=scales, quats=quats)
    frame = drawn(gaussians, camera(*size), response=response, **EVERYTHING)
    assert np.isfinite(frame.image).all()
    assert (frame.alpha <= 1).all()
    gradients = backward(frame, *weights(size), absolute=True)
    assert np.isfinite(gradients.colors).all()
    assert np.isfinite(gradients.opacities).all()
    zero_quats = ~quats.any(1)
    assert zero_quats.any()
    assert not frame.projected.radii[zero_quats].any()
    for name in PARAMETERS:
        assert not np.isnan(getattr(gradients, name)).any(), name
        assert not getattr(gradients, name)[zero_quats].any(), name


def test_compositing_ends_early_with_very_many_gaussians_in_one_pixel():
    count = 200_000
    many = splats(
        np.full((count, 2), 0.5), np.full(count, 2.0), np.full(count, 1e-3), np.full(count, 0.004),
        np.ones((count, 3)), (1, 1),
    )  # fmt: skip
    frame = drawn(many, camera(1, 1), **EVERYTHING)
    # Each lets 0.996 through; the last blended leaves at least 1e-4.
    blended = int(np.floor(np.log(1e-4) / np.log(1 - np.float32(0.004))))
    assert abs(int(frame.pixels.sum()) - blended) <= 1
    assert frame.alpha[0, 0] == pytest.approx(1 - 1e-4, abs=1e-6)
    assert (
        np.count_nonzero(backward(frame, np.ones((1, 1, 3), np.float32)).colors[:, 0])
        <= blended + 1
    )


@pytest.mark.parametrize("count", [1, 2, 5000])
def test_items_of_equal_depth_keep_their_order(count):
    items = np.arange(count, dtype=np.int32)[::-1].copy()
    np.testing.assert_array_equal(order_by_depth(np.full(count, 2.5), items), items)


@pytest.mark.parametrize("count", [0, 1, 2, 1023, 1025, 5000])
@pytest.mark.parametrize("magnitudes", [1e-6, 0.1, 3, 20, 700])
def test_the_sort_by_depth_is_stable(count, magnitudes):
    rng = np.random.default_rng(count)
    depths = np.exp(rng.uniform(-magnitudes, magnitudes, count))
    depths[rng.uniform(size=count) < 0.5] = 1.0
    order = order_by_depth(depths, np.arange(count, dtype=np.int32))
    # Depths that agree to 2e-10 count as equal.
    known = (depths.view(np.int64) >> 20).astype(np.float64)
    np.testing.assert_array_equal(order, np.argsort(known, kind="stable"))
    assert all(known[a] < known[b] or a < b for a, b in pairwise(order))


def test_too_many_pairs_of_gaussian_and_tile_are_refused():
    count, size = 2**12, (2**15, 2**15)
    huge = splats(np.full((count, 2), 100.0), np.ones(count), np.full(count, 1e7), np.ones(count),
                  np.ones((count, 3)), size)  # fmt: skip
    with pytest.raises(MemoryError, match="too many"):
        drawn(huge, camera(*size))


@pytest.mark.parametrize("width", range(65, 73))
def test_pixels_are_the_same_if_the_image_ends_within_a_patch(width):
    gaussians, shown = cloud(60, (32, 24), seed=5), DrawOptions(depth=True)
    whole, cut = camera(128, 32), replace(camera(128, 32), width=width, height=21)
    # The Jacobian's bounds follow the size of the image; these means lie far within.
    gaussians = replace(gaussians, means=gaussians.means * np.float32([0.2, 0.2, 1.0]))
    full, part = (forward(gaussians, view, BLACK, shown) for view in (whole, cut))
    np.testing.assert_array_equal(part.image, full.image[:21, :width])
    np.testing.assert_array_equal(part.alpha, full.alpha[:21, :width])
    np.testing.assert_array_equal(part.depth, full.depth[:21, :width])
    rng = np.random.default_rng(1)
    v_image, v_alpha, v_depth = (np.zeros(shape, np.float32) for shape in _shapes(full))
    for v in (v_image, v_alpha, v_depth):
        v[:21, :width] = rng.normal(size=v[:21, :width].shape)
    inside = [np.ascontiguousarray(v[:21, :width]) for v in (v_image, v_alpha, v_depth)]
    of_full, of_part = backward(full, v_image, v_alpha, v_depth), backward(part, *inside)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(of_part, name), getattr(of_full, name))


def _shapes(frame):
    return frame.image.shape, frame.alpha.shape, frame.alpha.shape
