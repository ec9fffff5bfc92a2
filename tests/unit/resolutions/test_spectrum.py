"""The spectrum that scales keep, against a discrete Fourier transform by definition."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.resolutions import spectral
from crossgrad_plugins.resolutions.spectral import (
    GRID,
    amplitudes_within,
    grey_window,
    kept_shares,
)

VIEW = sample_scene().train_views[0]


@dataclass(frozen=True, eq=False)
class Given:
    """A photo of these pixels."""

    pixels: torch.Tensor
    counts: torch.Tensor | None = None

    def image(self):
        return self.pixels

    def mask(self):
        return self.counts


def views_of(*photos):
    return [replace(VIEW, photo=photo) for photo in photos]


def transformed(length):
    """The matrix of the discrete Fourier transform, and each row's frequency, cycles per pixel."""
    number = np.arange(length)
    matrix = np.exp(-2j * np.pi * np.outer(number, number) / length)
    return matrix, np.minimum(number, length - number) / length


def by_definition(grey, scale):
    """Sum of the amplitudes whose frequencies an image of `scale` of the size has."""
    (down, rows), (across, columns) = map(transformed, grey.shape)
    amplitudes = np.abs(down @ grey @ across.T)
    kept = np.maximum.outer(rows, columns) <= scale / 2 + 1e-12
    return amplitudes[kept].sum()


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 14), st.integers(1, 14), st.integers(0, 999))
def test_sums_of_amplitudes_agree_with_the_definition(height, width, seed):
    grey = np.random.default_rng(seed).uniform(0, 255, (height, width))
    found = amplitudes_within(grey)
    assert found.shape == (GRID + 1,)
    for step in (0, 1, 17, 36, 64, 100, 128, 170, 200, 255, 256):
        expected = by_definition(grey, step / GRID)
        assert found[step] == pytest.approx(expected, rel=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(1, 3), st.integers(0, 999))
def test_kept_shares_of_the_spectrum_grow_from_the_share_of_the_mean_colour_to_one(
    height, width, photos, seed
):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (photos, height, width, 3), dtype=np.uint8)
    shares = kept_shares(views_of(*(Given(torch.from_numpy(each)) for each in pixels)))
    assert shares[-1] == 1.0
    assert (np.diff(shares) >= 0).all() and shares[0] >= 0
    sums = [[by_definition(p.mean(2), s) for s in (0.25, 0.5, 1.0)] for p in pixels]
    quarter, half, whole = np.mean(sums, axis=0)
    if whole > 0:
        assert shares[64] == pytest.approx(quarter / whole, rel=1e-12)
        assert shares[128] == pytest.approx(half / whole, rel=1e-12)


@pytest.mark.parametrize("grey", [0, 90])
def test_a_photo_of_one_colour_keeps_all_its_shares(grey):
    photo = Given(torch.full((9, 12, 3), grey, dtype=torch.uint8))
    assert kept_shares(views_of(photo)) == pytest.approx(np.ones(GRID + 1), abs=1e-9)


def test_masked_pixels_do_not_change_the_shares():
    rng = np.random.default_rng(0)
    image = torch.from_numpy(rng.integers(0, 256, (16, 24, 3), dtype=np.uint8))
    mask = torch.from_numpy(rng.random((16, 24)) < 0.7)
    other = torch.where(mask[..., None], image, torch.tensor(200, dtype=torch.uint8))
    one, two = (kept_shares(views_of(Given(each, mask))) for each in (image, other))
    assert (one == two).all()
    assert not (one == kept_shares(views_of(Given(image)))).all()
    nothing = kept_shares(views_of(Given(image, torch.zeros_like(mask))))
    assert (nothing == 1.0).all()


def test_the_middle_of_a_large_photo_is_measured_at_full_resolution(monkeypatch):
    monkeypatch.setattr(spectral, "_WINDOW", 8)
    image = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (13, 20, 3), dtype=np.uint8))
    expected = image[2:10, 6:14].double().mean(2).numpy()
    assert grey_window(image, None) == pytest.approx(expected)
    mask = torch.ones(13, 20, dtype=torch.bool)
    assert grey_window(image, mask).shape == (8, 8)


def test_a_crop_keeps_the_shares_of_the_whole_and_a_half_size_copy_does_not():
    rng = np.random.default_rng(0)
    size = 256
    # A photo that is blurred: of amplitudes like 1 / frequency a copy would keep the same.
    blur = np.exp(-6.0 * np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size))))
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * blur).real
    shares = [each / each[-1] for each in map(amplitudes_within, (
        noise, noise[64:192, 64:192], noise.reshape(128, 2, 128, 2).mean((1, 3)),
    ))]  # fmt: skip
    whole, part, copy = (each[[64, 128]] for each in shares)
    assert part == pytest.approx(whole, abs=0.04)
    assert (whole - copy > 0.08).all()


def test_bits_do_not_depend_on_the_number_of_threads(monkeypatch):
    rng = np.random.default_rng(0)
    photos = [Given(torch.from_numpy(rng.integers(0, 256, (31, 47, 3), dtype=np.uint8)))] * 5
    before = torch.get_num_threads()
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        monkeypatch.setattr(spectral, "_AT_ONCE", threads)
        found.append(kept_shares(views_of(*photos)))
    torch.set_num_threads(before)
    assert (found[0] == found[1]).all()
