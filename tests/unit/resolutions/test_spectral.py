"""The scales of a run: by the definition, in bounds, per regime, never falling."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.contract.contexts import ScaleContext, ViewSample
from crossgrad_core.contract.schedule import Counting, Schedule, ViewsPerStepSpec
from crossgrad_core.errors import UserError
from crossgrad_core.plugin import PluginState
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import sample_scene, step_fields
from crossgrad_plugins.resolutions import spectral
from crossgrad_plugins.resolutions.coarse_to_fine import LATEST, window_of
from crossgrad_plugins.resolutions.octaves import Octaves
from crossgrad_plugins.resolutions.spectral import GRID, MOST_PHOTOS, Scales, Spectral, _Group

WIDTH, HEIGHT = 320, 240


@cache
def blurred(seed, blur):
    """[H, W, 3] noise that is blurred the more the higher that number is."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH))
    frequencies = np.hypot(np.fft.fftfreq(HEIGHT)[:, None], np.fft.fftfreq(WIDTH)[None])
    image = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-blur * frequencies)).real
    grey = (127 + 60 * image / image.std()).clip(0, 255).astype(np.uint8)
    return torch.from_numpy(np.repeat(grey[..., None], 3, axis=2))


class Blurred:
    """Such a photo; counts how often it is read."""

    def __init__(self, seed, blur):
        self.seed, self.blur, self.times = seed, blur, 0

    def image(self):
        self.times += 1
        return blurred(self.seed, self.blur)

    def mask(self):
        return None


def scene_of(near, far, views=None):
    """The sample scene with photos of that blur in either regime."""
    plain = sample_scene()
    chosen = plain.views if views is None else plain.views * views
    return replace(
        plain,
        views=tuple(
            replace(
                view,
                name=f"{index}",
                camera=view.camera.resized(WIDTH, HEIGHT),
                photo=Blurred(index % 12, near if view.regime == "near" else far),
            )
            for index, view in enumerate(chosen)
        ),
        train=tuple(range(len(chosen))),
        test=(),
    )


ALIKE, APART = scene_of(4, 4), scene_of(2, 12)


def asked(resolution, schedule, step, state=None, scene=APART, views=(0, 8)):
    """Scales of a far and a near view, and the state."""
    fields = {**step_fields(step), "schedule": schedule, "scene": scene}
    context = ScaleContext(**fields, draw=ViewSample(tuple(views)), last=None)
    return resolution.scales(context, state or PluginState())


def group_of(kept, shorter):
    return _Group(sample_scene().train_views, kept, shorter)


def by_definition(kept, least, ratio, levels, progress):
    """Scale after a share of the window, level by level."""
    first = next(n for n in range(GRID + 1) if n >= least * GRID and kept[n] >= 1 / ratio)
    if first == GRID:
        return 1.0
    numbers = sorted({round(first + (GRID - first) * i / levels) for i in range(levels + 1)})
    last_time, last_pixels = 0.0, (first / GRID) ** 2
    reached = last_pixels
    for number in numbers:
        time, pixels = kept[number], (number / GRID) ** 2
        if number == first:
            if progress <= time:
                return first / GRID
        elif progress < time:
            share = (progress - last_time) / (time - last_time)
            return (last_pixels + share * (pixels - last_pixels)) ** 0.5
        if time <= progress:
            reached = pixels
        last_time, last_pixels = time, pixels
    return reached**0.5


@st.composite
def spectra(draw):
    """Random growing shares, with flat parts among them."""
    rng = np.random.default_rng(draw(st.integers(0, 9999)))
    steps = rng.exponential(size=GRID + 1) ** draw(st.sampled_from([0.3, 1, 4]))
    steps[rng.random(GRID + 1) < draw(st.sampled_from([0.0, 0.5, 0.97]))] = 0.0
    steps[0] += draw(st.sampled_from([0.0, 1e-9, 5.0]))
    total = np.cumsum(steps)
    return total / total[-1] if total[-1] > 0 else np.ones(GRID + 1)


@settings(max_examples=150, deadline=None)
@given(
    spectra(),
    st.sampled_from([96, 120, 200, 240, 1000]),
    st.sampled_from([1.0, 2.0, 4.0, 7.3]),
    st.sampled_from([1.5, 4.0, 50.0]),
    st.integers(1, 40),
)
def test_render_scales_agree_with_the_definition(kept, shorter, coarsest, ratio, levels):
    resolution = Spectral(coarsest=coarsest, ratio=ratio, levels=levels)
    scales = resolution._scales(group_of(kept, shorter))
    least = min(1.0, max(1 / coarsest, 96 / shorter))
    expected = [by_definition(kept, least, ratio, levels, k / levels) for k in range(levels)]
    assert len(scales) in {0, levels}
    assert (scales or (1.0,) * levels) == pytest.approx(expected, abs=6e-5)
    assert all(least - 1e-4 <= scale <= 1.0 for scale in scales)
    assert (np.diff(scales) >= 0).all()


def test_render_scales_of_a_flat_spectrum_follow_the_published_rule():
    # All scales alike in frequency: X(F_r) / X(F) = 1 / r^2, so that 1/r = 1/2 has a quarter.
    kept = (np.arange(GRID + 1) / GRID) ** 2
    scales = Spectral(levels=4)._scales(group_of(kept, 10_000))
    assert scales == pytest.approx([0.5, 0.5, 0.5**0.5, 0.75**0.5], abs=1e-4)


@pytest.mark.parametrize(
    ("scene", "per_regime", "names"),
    [
        (ALIKE, "auto", ["all"]),
        (APART, "auto", ["far", "near"]),
        (ALIKE, "always", ["far", "near"]),
        (APART, "never", ["all"]),
    ],
)
def test_regimes_get_separate_render_scales_if_their_spectra_differ(scene, per_regime, names):
    resolution = Spectral(per_regime=per_regime).fitted_to(scene)
    assert sorted(resolution.courses) == names
    photos = {name: each.photos for name, each in resolution.courses.items()}
    assert sum(photos.values()) == len(scene.train_views)
    schedule = Schedule.for_run(3000)
    (text,) = resolution.messages(schedule)
    assert text.startswith("resolution: far 1/" if len(names) == 2 else "resolution: 1/")
    # Blurred photos keep their spectrum at a coarser scale, and so they stay there for longer.
    (far, near), _ = asked(resolution, schedule, 1100, scene=scene)
    if scene is APART and len(names) == 2:
        assert far < 0.8 * near
    else:
        assert far == pytest.approx(near, rel=0.02)


def test_a_fitted_resolution_is_read_back_without_a_new_measurement():
    resolution = Spectral().fitted_to(APART)
    again = Spectral.model_validate(resolution.model_dump(mode="json"))
    assert again == resolution
    # Nothing is measured again, whatever the photos.
    assert again.fitted_to(ALIKE) is again
    schedule = Schedule.for_run(2000)
    for step in (1, 700, 1001):
        known, _ = asked(again, schedule, step)
        assert known == asked(Spectral(), schedule, step)[0]


def test_an_unknown_regime_also_gets_render_scales():
    resolution = Spectral(courses={"street": Scales(photos=3, scales=(0.5,))})
    assert asked(resolution, Schedule.for_run(1000), 1)[0] == (0.5, 0.5)


def test_a_limited_number_of_photos_is_measured():
    scene = scene_of(4, 4, views=7)
    assert len(scene.train_views) == 84 > MOST_PHOTOS
    Spectral(per_regime="never").fitted_to(scene)
    times = [view.photo.times for view in scene.train_views]
    assert sum(times) == MOST_PHOTOS and max(times) == 1
    assert times[0] == times[-1] == 1


@pytest.mark.parametrize("resolution", [Spectral().fitted_to(APART), Octaves()])
def test_a_step_does_not_read_photos(resolution, monkeypatch):
    monkeypatch.setattr(spectral, "kept_shares", None)
    schedule, state = Schedule.for_run(900), PluginState()
    for step in range(1, 901, 100):
        _, state = asked(resolution, schedule, step, state)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (97, 300), (101, 101), (250, 130)])
@pytest.mark.parametrize("resolution", [Spectral().fitted_to(APART), Octaves()])
def test_the_shorter_side_keeps_a_minimum_of_pixels(resolution, width, height):
    views = [replace(v, camera=v.camera.resized(width, height)) for v in APART.views]
    scene, schedule = replace(APART, views=tuple(views)), Schedule.for_run(1000)
    for step in range(1, 1001, 37):
        for scale in asked(resolution, schedule, step, scene=scene)[0]:
            sides = round(width * scale), round(height * scale)
            assert scale == 1.0 or min(sides) >= 96
            assert 0 < scale <= 1.0


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", ["adc", "mcmc", "revising", "none"])
@pytest.mark.parametrize(("total", "mode"), [(20, "scaled"), (3000, "scaled"), (30_000, "scaled"),
                                             (700, "absolute"), (30_000, "absolute")])  # fmt: skip
def test_views_have_full_size_after_the_end_of_density_control(name, total, mode):
    schedule = build("densifiers", name, {}).window(Schedule.for_run(total, mode))
    window = window_of(schedule, None)
    if schedule.grows:
        assert window == min(schedule.densify_until, LATEST * total)
    else:
        assert window == total / 2
    resolution = Spectral().fitted_to(ALIKE)
    # Once at full size, always: no scale falls.
    full = [asked(resolution, schedule, step)[0] == (1.0, 1.0) for step in range(1, total + 1, 37)]
    assert full == sorted(full)
    assert asked(resolution, schedule, int(window) + 1)[0] == (1.0, 1.0)
    assert asked(resolution, schedule, total)[0] == (1.0, 1.0)
    assert asked(resolution, schedule, 1)[0] < (0.6, 0.6)
    assert window_of(schedule, 0.25) == total / 4


PLANS = [ViewsPerStepSpec(), ViewsPerStepSpec((3,)), ViewsPerStepSpec((1, 4), (0.3,))]


@pytest.mark.sampled(6)
@pytest.mark.parametrize("plan", PLANS, ids=str)
@pytest.mark.parametrize("unit", ["views", "steps"])
@pytest.mark.parametrize(
    "resolution",
    [
        Spectral(smallest=1).fitted_to(APART),
        Octaves(smallest=1),
        Octaves(quarter_until=0, half_until=0),
    ],
)
def test_a_budget_counts_the_rendered_pixels(resolution, unit, plan):
    schedule = Schedule.for_run(400, counting=Counting(unit, plan, 10))
    drawn, done = 0.0, [0.0]
    for step in range(1, 401):
        scales, _ = asked(resolution, schedule, step)
        drawn += schedule.pace.at(step) * np.mean([scale**2 for scale in scales])
        done.append(drawn)
    if unit == "steps" and plan.shares:
        return  # The K of the steps so far is taken for all of them.
    found = [resolution.pixels(schedule, step) for step in range(401)]
    # A step of several views has one scale, and what is nearly full is.
    assert found == pytest.approx(done, abs=0.02 * drawn)
    assert (np.diff(found) > 0).all()
    assert found[0] == 0.0


@pytest.mark.parametrize("resolution", [Spectral().fitted_to(APART), Octaves()])
@settings(max_examples=25, deadline=None)
@given(lengths=st.lists(st.integers(50, 4000), min_size=1, max_size=5), seed=st.integers(0, 99))
def test_no_render_scale_decreases_when_the_length_of_a_run_changes(resolution, lengths, seed):
    rng = np.random.default_rng(seed)
    schedule, state, last = Schedule.for_run(lengths[0]), PluginState(), (0.0, 0.0)
    step = 0
    for length in lengths:
        schedule = schedule.with_length(Schedule.for_run(max(length, step + 1)), step)
        for _ in range(8):
            step = min(schedule.total, step + int(rng.integers(1, 60)))
            scales, state = asked(resolution, schedule, step, state)
            assert all(now >= before for now, before in zip(scales, last, strict=True))
            last = scales
    # A shorter run than was thought is at full size in the end all the same.
    assert asked(resolution, schedule, schedule.total, state)[0] == (1.0, 1.0)


def test_octaves_use_a_quarter_then_a_half_then_the_full_size():
    resolution, schedule = Octaves(quarter_until=0.2, half_until=0.5), Schedule.for_run(100)
    scene = replace(APART, views=tuple(
        replace(v, camera=v.camera.resized(800, 600)) for v in APART.views))  # fmt: skip
    scales = [asked(resolution, schedule, step, scene=scene)[0][0] for step in range(1, 101)]
    assert scales == [0.25] * 20 + [0.5] * 30 + [1.0] * 50
    assert resolution.messages(schedule) == (
        "resolution: 1/4 to step 20, 1/2 from step 21, full size from step 51; "
        "no side has fewer than 96 pixels",
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"quarter_until": 0.0}, "1/2 to step 40, full size from step 41"),
        ({"half_until": 0.2}, "1/4 to step 20, full size from step 21"),
        ({"quarter_until": 0.0, "half_until": 0.0}, "full size"),
    ],
)
def test_a_size_of_octaves_may_be_omitted(options, text):
    (told,) = Octaves(**options).messages(Schedule.for_run(100))
    assert told == f"resolution: {text}; no side has fewer than 96 pixels"


def test_render_sizes_of_octaves_that_are_out_of_order_are_refused():
    with pytest.raises(UserError, match="half_until must be at least"):
        build("resolutions", "octaves", {"quarter_until": 0.5, "half_until": 0.3})


def test_the_note_names_the_steps_at_which_the_render_scales_change():
    resolution, schedule = Spectral().fitted_to(APART), Schedule.for_run(2000)
    (text,) = resolution.messages(schedule)
    told = dict(zip(("far", "near"), text.removeprefix("resolution: ").split("; "), strict=True))
    for place, (name, line) in enumerate(told.items()):
        coarsest, half, full = (part.split()[-1] for part in line.split(", "))
        scales = [asked(resolution, schedule, step)[0][place] for step in range(1, 2001)]
        assert line.startswith(f"{name} 1/{1 / scales[0]:.3g} to step")
        assert scales[int(coarsest) - 1] == scales[0] < scales[int(coarsest)]
        assert scales[int(half) - 2] < 0.5 <= scales[int(half) - 1]
        assert resolution.courses[name].scales[-1] < 1.0
        assert int(full) == 1001
