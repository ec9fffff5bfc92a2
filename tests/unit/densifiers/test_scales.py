"""Density control sees the same statistics whatever the scale of the renders."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.registry.entries import build, offers
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

WIDTH, HEIGHT = 192, 128
#: Scale -> options of `octaves` with which all views of the first steps have it.
SCALES = {
    1.0: {"quarter_until": 0, "half_until": 0},
    0.5: {"quarter_until": 0, "half_until": 0.9},
    0.25: {"quarter_until": 0.9, "half_until": 0.9},
}
NAMES = sorted(each.name for each in offers("densifiers") if each.distribution == "crossgrad")


@dataclass(frozen=True)
class Waves:
    """A photo without details: all that it shows is there at a quarter of its size, too."""

    seed: int

    def image(self):
        rng = np.random.default_rng(self.seed)
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / WIDTH
        phases, turns = rng.uniform(0, 6, 3), rng.uniform(3, 9, (3, 2))
        waves = [np.sin(a * x + b * y + c) for (a, b), c in zip(turns, phases, strict=True)]
        return torch.from_numpy((127.5 + 120 * np.stack(waves, -1)).astype(np.uint8))

    def mask(self):
        return None


@cache
def scene():
    """The sample scene with such photos, and with points so close that Gaussians are smooth."""
    plain = sample_scene()
    views = tuple(
        replace(view, camera=view.camera.resized(WIDTH, HEIGHT), photo=Waves(index))
        for index, view in enumerate(plain.views)
    )
    return replace(plain, views=views)


def backbone_for(densifier):
    tensors = build("densifiers", densifier, {}).tensors or frozenset()
    if "lattice" in tensors:
        return "octree"
    return "scaffold" if "anchors" in tensors else "vanilla"


def stepped(densifier, scale, start, steps):
    """State and records of steps of three views whose learning rates are next to nothing."""
    settings = {
        "densifier": {"name": densifier},
        "backbone": {"name": backbone_for(densifier)},
        "resolution": {"name": "octaves", "smallest": 1, **SCALES[scale]},
        "views_per_step": 3,
        "rate_factor": 1e-6,
    }
    setup = assemble(RunConfig.model_validate(settings), scene(), "none")
    state = first_state(setup)
    state.step = start(setup.schedule)
    records = [timed_step(setup, state) for _ in range(steps)]
    assert all(record.scales == (scale,) * 3 for record in records)
    return state, records


def observed(densifier, scale):
    """The statistics of two steps, none of which edits; anchors begin later to gather them."""
    start = lambda schedule: schedule.step_of(schedule.densify_from // 3) + 1  # noqa: E731
    state, _ = stepped(densifier, scale, start, 2)
    return state.states["densifier"].per_primitive


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", NAMES)
def test_statistics_do_not_depend_on_the_render_scale(name):
    full = observed(name, 1.0)
    if not full:
        pytest.skip("uses no statistics of views")
    for scale in (0.5, 0.25):
        found = observed(name, scale)
        assert found.keys() == full.keys()
        for statistic, values in found.items():
            # Pixels would be 4 and 16 times fewer, gradients per pixel 2 and 4 times larger; what
            # is left is the blur of larger pixels.
            ratio = float(values.double().sum() / full[statistic].double().sum())
            assert ratio == pytest.approx(1.0, abs=0.25), (scale, statistic)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scale", [0.5, 0.25])
def test_error_shares_refer_to_the_full_photo_at_any_render_scale(scale):
    start = lambda schedule: schedule.first_edit - 1  # noqa: E731
    (_, (full,)), (_, (small,)) = (stepped("revising", each, start, 1) for each in (1.0, scale))
    assert full.counts["cloned"] + full.counts["split"] > 0
    assert small.counts == full.counts
