"""One pixel of each n x n: the very pixels of the full render, each as often as the others."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import ScaleContext, ViewSample
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene, step_fields
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_core.training.strided_rendering import (
    as_in_full,
    camera_of,
    corner_of,
    pixels_of,
    stride_of,
)
from crossgrad_core.training.views import RenderCallback, target_at

BLACK = torch.zeros(3, dtype=torch.float64)
CORNERS = [(2, 0, 0), (2, 1, 0), (2, 0, 1), (2, 1, 1), (3, 2, 1), (4, 3, 3), (5, 1, 4)]


@pytest.mark.parametrize("response", ["plain", "antialiased"])
@pytest.mark.parametrize(("stride", "column", "row"), CORNERS)
def test_the_strided_reference_renders_exact_pixels_of_the_full_image(
    stride, column, row, response
):
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
def test_strided_kernels_render_exact_pixels_of_the_full_image(stride, column, row):
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


def test_gradients_of_all_pixel_corners_add_up_to_the_gradient_of_the_full_image():
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
def test_every_pixel_corner_is_used_about_equally_for_any_sampler_period(stride):
    for period in (1, 2, 3, 4, 7, 112):
        turns = Counter(corner_of(step, 0, stride) for step in range(1, 4000 * period, period))
        assert len(turns) == stride**2
        assert max(turns.values()) < 1.35 * min(turns.values())
    slots = Counter(tuple(corner_of(step, slot, 2) for slot in (0, 1)) for step in range(1, 4000))
    assert len(slots) == 16, "the views of a step have corners of their own"


@pytest.mark.parametrize(
    ("scale", "stride"), [(1.0, 1), (0.5, 2), (1 / 3, 3), (0.25, 4), (0.6, 1), (0.45, 1), (0.2, 5)]
)
def test_strides_exist_only_for_render_scales_that_divide_the_size_by_a_whole_number(scale, stride):
    assert stride_of(scale, posed_camera()) == stride


def test_no_stride_exceeds_the_size_of_the_photo():
    assert stride_of(1 / 8, posed_camera(8, 9)) == 8
    assert stride_of(1 / 8, posed_camera(9, 7)) == 1


def test_masks_are_sampled_at_the_pixels_of_the_strided_render():
    image = torch.arange(5 * 7 * 3, dtype=torch.uint8).reshape(5, 7, 3)
    mask = image[..., 0] > 40
    small, kept = pixels_of((image, mask), 2, (1, 0))
    assert torch.equal(small, image[0::2, 1::2]) and torch.equal(kept, mask[0::2, 1::2])
    assert pixels_of((image, None), 2, (1, 0))[1] is None


@pytest.mark.parametrize(
    ("width", "height", "scale", "expected"),
    [
        (640, 400, 1 / 2, 2),
        (640, 400, 1 / 8, 2),  # 60,000 pixels
        (400, 298, 1 / 2, 1),
        (2000, 150, 1 / 2, 1),  # a shorter side of 96
        (1600, 1200, 1 / 8, 5),
        (4000, 3000, 1 / 8, 8),
        (5, 3, 1 / 2, 1),
    ],
)
def test_every_photo_keeps_enough_pixels_under_strided_rendering(width, height, scale, expected):
    resolution = build("resolutions", "strided", {})
    assert 1 / resolution.of_photo(posed_camera(width, height), scale) == pytest.approx(expected)


def scene_of(width, height):
    plain = sample_scene()
    views = (replace(v, camera=v.camera.resized(width, height)) for v in plain.views)
    return replace(plain, views=tuple(views))


@pytest.mark.parametrize(
    ("width", "height", "coarsest", "scales", "note"),
    [
        (400, 298, 1, [(200, 1.0)], None),
        (640, 400, 2, [(160, 1 / 2), (40, 1.0)], "2 x 2 to step 160"),
        (1600, 1200, 4, [(96, 1 / 4), (64, 1 / 2), (40, 1.0)],
         "4 x 4 to step 96, of each 2 x 2 to step 160"),
        (4000, 3000, 8, [(48, 1 / 8), (48, 1 / 4), (64, 1 / 2), (40, 1.0)],
         "8 x 8 to step 48, of each 4 x 4 to step 96, of each 2 x 2 to step 160"),
    ],
)  # fmt: skip
def test_strided_stages_follow_the_size_of_the_photos(width, height, coarsest, scales, note):
    scene, schedule = scene_of(width, height), Schedule.for_run(200)
    resolution = build("resolutions", "strided", {}).fitted_to(scene)
    assert resolution.coarsest == coarsest
    state, found = PluginState(), []
    for step in range(1, 201):
        context = ScaleContext(
            **{**step_fields(step), "scene": scene, "schedule": schedule,
               "rng": np.random.default_rng(0)},
            draw=ViewSample((0,)), last=None,
        )  # fmt: skip
        (scale,), state = resolution.scales(context, state)
        found.append(scale)
    assert found == [scale for count, scale in scales for _ in range(count)]
    (remark,) = resolution.messages(schedule)
    if note is None:
        assert "all pixels from the start, because resolution.coarsest is 1" in remark
        assert "fewer than 240,000 pixels or with a side of fewer than 192" in remark
    else:
        assert f"one pixel of each {note}, another one in each step; then all pixels" in remark
    pixels = sum(count * scale**2 for count, scale in scales)
    assert resolution.pixels(schedule, 200) == pytest.approx(pixels)


@pytest.mark.parametrize(
    ("steps", "share"),
    [(100, 0.8), (3000, 0.8), (9487, 0.4), (29_999, 0.0), (30_000, 0.0), (40_000, 0.0)],
)
def test_longer_runs_render_all_pixels_from_an_earlier_share_of_the_run(steps, share):
    resolution = build("resolutions", "strided", {"coarsest": 2})
    schedule = Schedule.for_run(steps)
    assert resolution.window(schedule) == pytest.approx(share * steps, abs=2e-4 * steps)
    assert resolution.pixels(schedule, steps) == pytest.approx((1 - 0.75 * share) * steps, rel=1e-3)
    (remark,) = resolution.messages(schedule)
    assert ("all pixels from the start: the run is long" in remark) == (steps >= 30_000)
    assert build("resolutions", "strided", {"until": 0.5}).window(schedule) == 0.5 * steps


def test_a_run_of_published_length_renders_all_pixels_from_the_first_step():
    setup = assembled(steps=30_000)
    assert timed_step(setup, first_state(setup)).scales == (1.0,)


USUAL = {
    "a short run": ({}, "strided"),
    "views": ({"steps": None, "max_views": 2000}, "strided"),
    "seconds": ({"steps": None, "seconds": 60}, "strided"),
    "as long as published": ({"steps": 30_000}, "full"),
    "no length": ({"steps": None}, "full"),
    "views as many": ({"steps": None, "max_views": 30_000}, "full"),
    "the recipe": ({"recipe": {"name": "published"}}, "full"),
    "absolute": ({"schedule": "absolute"}, "full"),
    "of another length": ({"schedule": "absolute", "schedule_length": 2000}, "strided"),
    "free growth": ({"growth": "unbounded"}, "full"),
    "a bound": ({"max_gaussians": 500}, "full"),
    "no growth": ({"densifier": {"name": "none"}}, "strided"),
    "anchors": ({"backbone": {"name": "scaffold"}}, "full"),
    "a filter": ({"backbone": {"name": "mip"}}, "full"),
    "means over pixels": ({"backbone": {"name": "analytic"}}, "full"),
    "named": ({"resolution": {"name": "octaves"}}, "octaves"),
    "the processor by number": ({"device": "cpu:0"}, "strided"),
}


@pytest.mark.parametrize("case", USUAL)
def test_strided_rendering_is_the_default_in_short_runs_of_plain_gaussians(case):
    settings, expected = USUAL[case]
    given = {"steps": 2000, "plan": "off", **settings}
    setup = assemble(RunConfig.model_validate(given), sample_scene(), "none")
    assert setup.selection.names["resolution"] == expected


@pytest.mark.parametrize(("asked", "coarsest"), [(1, 1), (2, 2), (4, 4), (8, 4)])
def test_a_named_stride_is_reduced_for_small_photos(asked, coarsest):
    scene = scene_of(400, 298)
    large = replace(scene.views[0], camera=scene.views[0].camera.resized(1600, 1200))
    scene = replace(scene, views=(large, *scene.views[1:]), train=(0, 1, 2))
    resolution = build("resolutions", "strided", {"coarsest": asked}).fitted_to(scene)
    assert resolution.coarsest == coarsest
    assert resolution.fitted_to(scene).coarsest == coarsest


def test_a_run_with_a_strided_share_of_zero_reports_so():
    resolution = build("resolutions", "strided", {"coarsest": 2, "until": 0.0})
    assert "this share of the run is 0" in resolution.messages(Schedule.for_run(100))[0]


def test_strided_rendering_refuses_a_rasterizer_with_a_fixed_dilation():
    gswarp, setup = build("rasterizers", "gswarp", {}), assembled()
    selection = replace(setup.selection, device="cuda", rasterizer=gswarp)
    told = gswarp.crossgrad_validate_selection(selection)
    assert any("resolution strided needs less" in each for each in told)


def assembled(**settings):
    given = {
        "resolution": {"name": "strided", "smallest": 4, "least": 16, "coarsest": 2},
        "steps": 20,
        **settings,
    }
    return assemble(RunConfig.model_validate(given), sample_scene(), "none")


def test_a_run_renders_some_pixels_first_and_all_pixels_at_the_end():
    setup = assembled(views=2)
    state = first_state(setup)
    assert [timed_step(setup, state).scales[0] for _ in range(20)] == [0.5] * 16 + [1.0] * 4


def test_rendered_pixels_are_photo_pixels_and_change_between_steps():
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
    on_request = RenderCallback(setup, state, counted=False)(0, 0.5)
    assert torch.equal(on_request.photo, target_at(setup, state, 0, 0.5).photo)
    assert on_request.gaussians.dilation == pytest.approx(0.3 / 4)
    assert target_at(setup, state, 0, 1.0, slot=0).stride == 1


def test_strided_rendering_refuses_a_response_that_averages_over_pixels():
    with pytest.raises(UserError, match="is a mean over all pixels"):
        assembled(backbone={"name": "analytic"})


def test_dilations_of_backbones_refer_to_the_full_photo():
    setup = assembled(backbone={"name": "mip"})
    state = first_state(setup)
    camera = setup.train_views[0].camera
    decoded = setup.backbone.decode(state.parameters, camera, setup.phase(1, training=True))
    assert decoded.dilation is not None
    small = as_in_full(decoded, setup.rasterizer, 2)
    assert small.dilation == pytest.approx(decoded.dilation / 4)
    record = timed_step(setup, state)
    assert record.scales == (0.5,) and np.isfinite(record.losses).all()
