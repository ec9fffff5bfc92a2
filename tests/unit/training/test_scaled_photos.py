"""Photos reduced by area, and kept in bounded memory."""

import numpy as np
import pytest
import torch

from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.screen_statistics import ndc_gradient, pixels, radii
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.records import view_record
from crossgrad_core.training.scaled_photos import ScaledPhoto, ScaledPhotos, reduced
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


def test_a_mask_that_leaves_nothing_out_is_none():
    assert reduced(IMAGE, torch.ones(23, 37, dtype=torch.bool), 9, 9)[1] is None


def test_memory_is_bounded_and_the_same_size_is_made_once():
    views = sample_scene().train_views
    made = []

    def full(view):
        made.append(view.name)
        return view.photo.image(), None

    photos = ScaledPhotos(1)
    first = photos.get(ScaledPhoto(views[0], 12, 8, full))
    assert photos.get(ScaledPhoto(views[0], 12, 8, full))[0] is first[0]
    assert photos.get(ScaledPhoto(views[0], 6, 4, full))[0].shape == (4, 6, 3)
    assert made == [views[0].name] * 2
    small = ScaledPhotos(0)
    for view in views:
        small.get(ScaledPhoto(view, 12, 8, full))
    assert small._cache.used == 12 * 8 * 3


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_statistics_are_those_of_the_full_photo_whatever_the_scale(scale):
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


def test_at_full_size_the_camera_is_the_view_s_own():
    camera = sample_scene().train_views[0].camera
    assert camera_at(camera, 1.0) is camera
    assert (camera_at(camera, 0.01).width, camera_at(camera, 0.01).height) == (1, 1)
