"""One pixel of each n x n: the very pixels of the full render, each as often as the others."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.interlaced import (
    as_in_full,
    camera_of,
    corner_of,
    pixels_of,
    stride_of,
)
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_core.training.views import target_at

BLACK = torch.zeros(3, dtype=torch.float64)
CORNERS = [(2, 0, 0), (2, 1, 0), (2, 0, 1), (2, 1, 1), (3, 2, 1), (4, 3, 3), (5, 1, 4)]


@pytest.mark.parametrize("response", ["plain", "antialiased"])
@pytest.mark.parametrize(("stride", "column", "row"), CORNERS)
def test_the_reference_draws_the_pixels_of_its_full_render(stride, column, row, response):
    camera = posed_camera(46, 34)
    # Nobody stands beyond the border, where positions are clamped by the size of the image.
    gaussians = random_gaussians(40, camera, sigmas=(0.05, 4.0), border=0.0, response=response)
    torch_, corner = build("rasterizers", "torch", {}), (column, row)
    whole = torch_.render(gaussians, camera, BLACK).image
    small = camera_of(camera, stride, corner)
    drawn = torch_.render(as_in_full(gaussians, torch_, stride), small, BLACK).image
    expected = whole[row::stride, column::stride]
    assert drawn.shape == expected.shape == (small.height, small.width, 3)
    # The factor of opacities has constants against division by zero, in pixels of the render.
    assert (drawn - expected).abs().max() < (1e-9 if response == "plain" else 1e-3)


@pytest.mark.parametrize(("stride", "column", "row"), CORNERS)
def test_kernels_draw_the_pixels_of_their_full_render(stride, column, row):
    camera = posed_camera(64, 48, focal=60.0)
    gaussians = random_gaussians(300, camera, sigmas=(0.2, 5.0), border=0.0).mapped(
        torch.Tensor.float
    )
    numba, corner = build("rasterizers", "numba", {}), (column, row)
    whole = numba.render(gaussians, camera, BLACK.float()).image
    small = camera_of(camera, stride, corner)
    drawn = numba.render(as_in_full(gaussians, numba, stride), small, BLACK.float()).image
    # An alpha beside 1/255 may be kept in one of them and not in the other.
    assert (drawn - whole[row::stride, column::stride]).abs().max() < 1.1 / 255
    assert (drawn - whole[row::stride, column::stride]).abs().mean() < 1e-5


def test_gradients_of_all_corners_add_up_to_those_of_the_full_render():
    camera = posed_camera(22, 16)
    start, torch_ = random_gaussians(20, camera, border=0.0), build("rasterizers", "torch", {})
    photo = torch.rand(16, 22, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def gradients(views):
        leaves = start.mapped(lambda tensor: tensor.clone().requires_grad_(requires_grad=True))
        for stride, corner in views:
            image = torch_.render(
                as_in_full(leaves, torch_, stride), camera_of(camera, stride, corner), BLACK
            ).image
            target = photo[corner[1] :: stride, corner[0] :: stride]
            (image - target).abs().sum().backward()
        return [tensor.grad for tensor in leaves.floats()]

    corners = [(2, (column, row)) for row in range(2) for column in range(2)]
    for one, other in zip(gradients(corners), gradients([(1, (0, 0))]), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("stride", [2, 3, 4])
def test_every_corner_has_its_turn_whatever_sampler_goes_through_the_photos(stride):
    for period in (1, 2, 3, 4, 7, 112):
        turns = Counter(corner_of(step, 0, stride) for step in range(1, 4000 * period, period))
        assert len(turns) == stride**2
        assert max(turns.values()) < 1.35 * min(turns.values())
    slots = Counter(tuple(corner_of(step, slot, 2) for slot in (0, 1)) for step in range(1, 4000))
    assert len(slots) == 16, "the views of a step have corners of their own"


@pytest.mark.parametrize(
    ("scale", "stride"), [(1.0, 1), (0.5, 2), (1 / 3, 3), (0.25, 4), (0.6, 1), (0.45, 1), (0.2, 5)]
)
def test_strides_are_those_of_whole_numbers(scale, stride):
    assert stride_of(scale) == stride


def test_masks_are_taken_at_the_same_pixels():
    image = torch.arange(5 * 7 * 3, dtype=torch.uint8).reshape(5, 7, 3)
    mask = image[..., 0] > 40
    small, kept = pixels_of((image, mask), 2, (1, 0))
    assert torch.equal(small, image[0::2, 1::2]) and torch.equal(kept, mask[0::2, 1::2])
    assert pixels_of((image, None), 2, (1, 0))[1] is None


@pytest.mark.parametrize(
    ("side", "smallest", "expected"),
    [(400, 96, 0.5), (191, 96, 1.0), (192, 96, 0.5), (100, 96, 1.0), (20, 96, 1.0), (16, 4, 0.5)],
)
def test_no_side_has_less_than_the_smallest(side, smallest, expected):
    resolution = build("resolutions", "interlaced", {"smallest": smallest})
    camera = replace(posed_camera(), width=2 * side, height=side)
    assert resolution.of_photo(camera, 0.5) == expected


def assembled(**settings):
    given = {"resolution": {"name": "interlaced", "smallest": 4}, "steps": 20, **settings}
    return assemble(RunConfig.model_validate(given), sample_scene(), "none")


def test_a_run_draws_some_pixels_and_then_all():
    setup = assembled(views=2)
    state = first_state(setup)
    assert [timed_step(setup, state).scales[0] for _ in range(20)] == [0.5] * 16 + [1.0] * 4


def test_pixels_are_those_of_the_photo_and_another_step_has_others():
    setup = assembled()
    state = first_state(setup)
    photo = setup.train_views[0].photo.image()
    found = []
    for step in range(1, 40):
        state.step = step
        target = target_at(setup, state, 0, 0.5, slot=0)
        column, row = corner_of(step, 0, 2)
        assert torch.equal(target.photo, photo[row::2, column::2])
        assert (target.camera.height, target.camera.width) == target.photo.shape[:2]
        found.append((column, row))
    assert len(set(found)) == 4
    # What a plugin asks for between steps is always the same.
    assert torch.equal(target_at(setup, state, 0, 0.5).photo, photo[0::2, 0::2])
    assert target_at(setup, state, 0, 1.0, slot=0).stride == 1


def test_a_response_that_is_a_mean_over_pixels_is_refused():
    with pytest.raises(UserError, match="is a mean over all of them"):
        assembled(backbone={"name": "analytic"})


def test_dilations_of_backbones_are_those_of_the_full_photo():
    setup = assembled(backbone={"name": "mip"})
    state = first_state(setup)
    camera = setup.train_views[0].camera
    decoded = setup.backbone.decode(state.parameters, camera, setup.phase(1, training=True))
    assert decoded.dilation is not None
    small = as_in_full(decoded, setup.rasterizer, 2)
    assert small.dilation == pytest.approx(decoded.dilation / 4)
    assert np.isfinite(timed_step(setup, state).losses).all()
