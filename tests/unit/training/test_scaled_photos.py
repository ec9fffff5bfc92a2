"""Photos reduced by area, and kept in bounded memory."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.screen_statistics import ndc_gradient, pixels, radii
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.renders import view_record
from crossgrad_core.training.scaled_photos import ScaledPhotos, _bytes, reduced
from crossgrad_core.training.views import camera_at

RNG = np.random.default_rng(0)
IMAGE = torch.from_numpy(RNG.integers(0, 256, (23, 37, 3), dtype=np.uint8))
MASK = torch.from_numpy(RNG.random((23, 37)) < 0.6)


def brute_force(image, mask, width, height):
    """Each new pixel by the overlap of its area with each old pixel's."""
    kept = np.ones(image.shape[:2]) if mask is None else mask.numpy().astype(float)

    def overlaps(length, count):
        edges = np.arange(count + 1) * length / count
        low = np.maximum(edges[:-1, None], np.arange(length)[None, :])
        high = np.minimum(edges[1:, None], np.arange(length)[None, :] + 1.0)
        return np.clip(high - low, 0.0, None)

    rows, columns = overlaps(image.shape[0], height), overlaps(image.shape[1], width)
    cover = rows @ kept @ columns.T
    sums = [rows @ (image[..., c].numpy() * kept) @ columns.T for c in range(3)]
    means = np.stack(sums, -1) / np.where(cover > 0, cover, 1.0)[..., None]
    return means, cover / (rows.sum(1)[:, None] * columns.sum(1)[None, :])


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "masked"])
@pytest.mark.parametrize(("width", "height"), [(18, 11), (37, 23), (1, 1), (36, 22), (12, 23)])
def test_each_pixel_is_the_mean_of_the_area_that_it_covers(width, height, mask):
    small, counts = reduced(IMAGE, mask, width, height)
    means, cover = brute_force(IMAGE, mask, width, height)
    assert small.dtype == torch.uint8
    # Half a grey level from rounding; where a mean is half-way either neighbour is right.
    assert np.abs(small.numpy() - means).max() <= 0.5 + 1e-9
    if mask is None:
        assert counts is None
    else:
        expected = cover >= 0.5
        sure = np.abs(cover - 0.5) > 1e-9
        found = np.ones_like(expected) if counts is None else counts.numpy()
        assert (found == expected)[sure].all()


def test_a_mask_without_masked_pixels_is_dropped():
    assert reduced(IMAGE, torch.ones(23, 37, dtype=torch.bool), 9, 9)[1] is None


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 24),
    width=st.integers(1, 24),
    shares=st.tuples(st.floats(0.01, 1.0), st.floats(0.01, 1.0)),
    kept=st.sampled_from([None, 0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_averages_of_random_photos_agree_with_brute_force(height, width, shares, kept, seed):
    rng = np.random.default_rng(seed)
    image = torch.from_numpy(rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
    mask = None if kept is None else torch.from_numpy(rng.random((height, width)) < kept)
    size = max(1, round(width * shares[0])), max(1, round(height * shares[1]))
    small, counts = reduced(image, mask, *size)
    means, cover = brute_force(image, mask, *size)
    assert np.abs(small.numpy() - means).max() <= 0.5 + 1e-9
    sure = np.abs(cover - 0.5) > 1e-9
    found = np.ones_like(sure) if counts is None else counts.numpy()
    assert (found == (cover >= 0.5))[sure].all()


def test_a_photo_with_another_memory_layout_gives_the_same_result():
    turned = IMAGE.transpose(0, 1).contiguous().transpose(0, 1)
    assert torch.equal(reduced(turned, MASK, 9, 8)[0], reduced(IMAGE, MASK, 9, 8)[0])


class Counted:
    """Full photos, and how often they were asked for."""

    def __init__(self):
        self.times = 0

    def __call__(self, view):
        self.times += 1
        return view.photo.image(), None


def resized(view, width, height):
    return view.camera.resized(width, height)


VIEWS = sample_scene().train_views  # 24 x 16 pixels


def test_consecutive_requests_for_the_same_photo_size_compute_it_once():
    view, full, photos = VIEWS[0], Counted(), ScaledPhotos(1)
    first = photos.get(view, resized(view, 20, 13), full)
    assert photos.get(view, resized(view, 20, 13), full)[0] is first[0]
    assert first[0].shape == (13, 20, 3) and full.times == 1
    # A half of it is on the way to what is smaller still, and serves again there.
    small = photos.get(view, resized(view, 11, 7), full)
    smaller = photos.get(view, resized(view, 7, 5), full)
    assert full.times == 2
    half = reduced(view.photo.image(), None, 12, 8)
    assert torch.equal(small[0], reduced(*half, 11, 7)[0])
    assert torch.equal(smaller[0], reduced(*half, 7, 5)[0])


def test_full_size_returns_the_photo_and_stores_no_copy():
    view, full, photos = VIEWS[0], Counted(), ScaledPhotos(1)
    photos.get(view, resized(view, 8, 6), full)
    assert photos._kept and photos._room < 2**20
    assert torch.equal(photos.get(view, view.camera, full)[0], view.photo.image())
    assert not photos._kept and photos._room == 2**20


def test_memory_is_bounded_and_evicted_photos_are_computed_again():
    full, photos = Counted(), ScaledPhotos(1)
    photos._room = room = 2 * 20 * 13 * 3
    for _ in range(2):
        for view in VIEWS[:3]:
            assert photos.get(view, resized(view, 20, 13), full)[0].shape == (13, 20, 3)
            assert sum(_bytes(made) for made in photos._kept.values()) <= room
    assert full.times == 3 + 1


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 24)), max_size=12), st.integers(0, 3))
@example([(1, 1), (1, 3)], 1)  # on the way to one pixel lies the size that is wanted next
def test_earlier_requests_for_a_scaled_photo_change_no_pixel(asked, room):
    photos = ScaledPhotos(room)
    photos._room = room * 1000
    for index, width in asked:
        view, camera = VIEWS[index], resized(VIEWS[index], width, max(1, width * 2 // 3))
        full, held = Counted(), photos.holds(view, camera)
        found = photos.get(view, camera, full)
        assert full.times == (0 if held else 1)
        alone = ScaledPhotos(0).get(view, camera, Counted())
        assert torch.equal(found[0], alone[0]) and found[0].shape[:2] == (camera.height, width)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_statistics_refer_to_the_full_photo_at_any_scale(scale):
    view = sample_scene().train_views[0]
    size = torch.tensor([view.camera.width, view.camera.height])
    gaussians = Gaussians(torch.zeros(1, 3), torch.zeros(1, 4), torch.ones(1, 3), torch.ones(1))
    # What covers 64 pixels of the full photo, and gradients per pixel of the render.
    screen = Screen(
        radii=torch.tensor([8.0 * scale]).int(),
        pixels=torch.tensor([64 * scale**2]).int(),
        mean_gradient=torch.tensor([[0.3, -0.2]]) / scale,
    )
    record = view_record(view, gaussians, screen, scale=scale)
    assert record.camera.width == view.camera.width * scale
    assert pixels(record).tolist() == [64.0]
    assert radii(record).tolist() == pytest.approx([8.0 / view.camera.width])
    expected = torch.tensor([[0.3, -0.2]]) * size / 2
    assert torch.allclose(ndc_gradient(record), expected, rtol=1e-6)


def test_the_camera_of_the_view_is_used_at_full_size():
    camera = sample_scene().train_views[0].camera
    assert camera_at(camera, 1.0) is camera
    assert (camera_at(camera, 0.01).width, camera_at(camera, 0.01).height) == (1, 1)
