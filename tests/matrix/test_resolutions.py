"""Every resolution of less than full size with every backbone and one, two or three views.

The normal run trains a pairwise design for a few steps, the run with `-m matrix` all of them.
"""

from dataclasses import replace
from itertools import product

import pytest
import torch
from support.pairwise import pairwise

from crossgrad_core.config import RunConfig
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import offers
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import NoisePhoto, sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.authoring.matrix.combinations import NEEDED

STEPS = 8
#: An edit at a small scale, one at a larger one, and one at full size.
TIMES = {"schedule_unit": "steps", "densify_from": 1, "densify_every": 2, "densify_until": 8}


def names(slot):
    return sorted(each.name for each in offers(slot) if each.distribution == "crossgrad")


OPTIONS = {
    "strided": {"smallest": 4, "least": 16},
    "octaves": {"smallest": 4},
    "spectral": {"smallest": 4, "per_regime": "always"},
}
SMALL = [name for name in names("resolutions") if name != "full"]
ALL = tuple(
    row
    for row in product(SMALL, names("backbones"), ("1", "2", "3"), ("whole", "masked"))
    if row[:2] != ("strided", "analytic")  # refused: a mean over pixels, of which some are drawn
)
DESIGN = pairwise(ALL)


class Masked(NoisePhoto):
    """A photo of which a part does not count."""

    def mask(self):
        return self.image()[..., 0] > 90


def scene_of(photos):
    plain = sample_scene()
    if photos == "whole":
        return plain
    views = (replace(view, photo=Masked(index)) for index, view in enumerate(plain.views))
    return replace(plain, views=tuple(views))


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    before = configure_threads()
    configure_threads(1)
    yield
    configure_threads(before)


def check(row):
    """Trains a combination to its end: all is finite, scales grow to 1, edits take place."""
    resolution, backbone, views, photos = row
    settings = {
        "resolution": {"name": resolution, **OPTIONS[resolution]},
        "backbone": {"name": backbone, **NEEDED.get(("backbone", backbone), {})},
        "views_per_step": int(views),
        "steps": STEPS,
        **TIMES,
    }
    setup = assemble(RunConfig.model_validate(settings), scene_of(photos), "none")
    state = first_state(setup)
    records = [timed_step(setup, state) for _ in range(STEPS)]
    scales = [record.scales for record in records]
    assert all(0 <= loss < 10 for record in records for loss in record.losses)
    assert all(len(each) == int(views) for each in scales)
    assert max(scales[0]) < 1.0
    assert set(scales[-1]) == {1.0}
    assert all(torch.isfinite(tensor).all() for tensor in state.parameters.values())


@pytest.mark.sampled(7)
@pytest.mark.parametrize("row", DESIGN, ids=" x ".join)
def test_every_resolution_trains_with_every_backbone_and_number_of_views(row):
    check(row)


@pytest.mark.matrix
@pytest.mark.parametrize("row", ALL, ids=" x ".join)
def test_every_resolution_backbone_and_number_of_views_trains(row):
    check(row)
