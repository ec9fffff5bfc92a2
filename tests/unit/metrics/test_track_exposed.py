"""PSNR with the exposure of a view from its SfM observations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.plugin import Camera, Compared, psnr
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.exposures.srgb import with_gain
from crossgrad_plugins.metrics.psnr_track import TrackExposedPSNR

SIDE = 48
CAMERA = Camera(SIDE, SIDE, 40.0, 40.0, 24.0, 24.0, torch.eye(4, dtype=torch.float64))
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])


def smooth():
    """A scene of soft colours in [0.2, 0.8]."""
    grid = torch.linspace(0, 3, SIDE)
    waves = [torch.cos(grid[:, None] + phase) * torch.sin(grid + phase) for phase in (0, 1, 2)]
    return 0.5 + 0.3 * torch.stack(waves, dim=-1)


def compared(drawn, photo, mask=None, points=POINTS):
    view = replace(sample_scene().test_views[0], camera=CAMERA)
    eight_bits = ((each.clamp(0, 1) * 255).round().to(torch.uint8) for each in (drawn, photo))
    return Compared(view, *eight_bits, mask, drawn, points)


@pytest.mark.parametrize("stops", [-2.0, -0.5, 0.0, 0.4])
def test_a_render_is_brought_to_the_exposure_of_its_photo(stops):
    drawn = smooth()
    photo = with_gain(drawn, torch.tensor(stops))
    assert TrackExposedPSNR().measure(compared(drawn, photo)) > 45
    if stops:
        pair = compared(drawn, photo)
        assert psnr(pair.render, pair.photo) < 30


def test_values_above_white_are_recovered():
    photo = smooth()
    drawn = with_gain(photo, torch.tensor(1.5))
    assert drawn.max() > 1
    assert TrackExposedPSNR().measure(compared(drawn, photo)) > 45


@pytest.mark.parametrize("value", [1.5, 3.0, 50.0])
def test_single_pixels_far_above_white_are_clipped_to_white(value):
    photo = smooth()
    drawn = with_gain(photo, torch.tensor(-0.5))
    drawn[8:12, 8:12] = value
    found = TrackExposedPSNR().measure(compared(drawn, photo))
    white = torch.where(drawn == value, 1.0, photo)
    assert found == pytest.approx(psnr(white, photo), abs=0.5)


def test_only_observed_positions_determine_the_exposure():
    drawn, photo = smooth(), with_gain(smooth(), torch.tensor(-1.0))
    mask = torch.ones(SIDE, SIDE, dtype=torch.bool)
    mask[:, :24] = False
    photo[:, :24] = 1.0
    assert TrackExposedPSNR().measure(compared(drawn, photo, mask)) > 45
    # Where no point is observed there is no figure, whatever the photo shows.
    assert TrackExposedPSNR().measure(compared(drawn, photo, points=POINTS[:0])) is None
    assert TrackExposedPSNR().measure(compared(drawn, photo, points=POINTS[:5])) is None


def test_observations_that_are_too_dark_or_clipped_do_not_count():
    drawn = smooth()
    assert TrackExposedPSNR().measure(compared(drawn, torch.zeros_like(drawn))) is None
    assert TrackExposedPSNR().measure(compared(drawn, torch.ones_like(drawn))) is None


def test_a_black_render_keeps_its_plain_psnr():
    photo = smooth()
    pair = compared(torch.zeros_like(photo), photo)
    assert TrackExposedPSNR().measure(pair) == pytest.approx(psnr(pair.render, pair.photo))


def test_structural_differences_lower_the_psnr_after_exposure_correction():
    drawn, photo = smooth(), with_gain(smooth().flip(0), torch.tensor(-1.0))
    assert TrackExposedPSNR().measure(compared(drawn, photo)) < 25
