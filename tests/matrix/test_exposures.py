"""Every exposure with every backbone and one, two or three views per step.

The normal run trains a pairwise design for a few steps; `make exposures` trains all for sixty.
"""

from itertools import product

import pytest
import torch
from support.pairwise import pairwise

from crossgrad_core.config import RunConfig
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import offers
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.per_image_params import STATE
from crossgrad_core.training.start import first_state
from crossgrad_plugins.authoring.matrix.combinations import NEEDED

FEW, MANY = 3, 60


def names(slot):
    return sorted(each.name for each in offers(slot) if each.distribution == "crossgrad")


ALL = tuple(product(names("exposures"), names("backbones"), ("1", "2", "3")))
DESIGN = pairwise(ALL)


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    before = configure_threads()
    configure_threads(1)
    yield
    configure_threads(before)


def check(row, steps):
    """Trains a combination with density control; all is finite, and the means stay neutral."""
    exposure, backbone, views = row[0], row[1], int(row[2])
    settings = {
        "exposure": {"name": exposure},
        "backbone": {"name": backbone, **NEEDED.get(("backbone", backbone), {})},
        "views_per_step": views,
        "steps": MANY,
    }
    setup = assemble(RunConfig.model_validate(settings), sample_scene(), "none")
    state = first_state(setup)
    records = [timed_step(setup, state) for _ in range(steps)]
    assert all(0 <= loss < 10 for record in records for loss in record.losses)
    assert all(len(record.views) == views for record in records)
    assert all(torch.isfinite(tensor).all() for tensor in state.parameters.values())
    if setup.per_photo:
        values = state.states[STATE].tensors[f"value.{setup.exposure.parameter}"]
        assert torch.isfinite(values).all()
        assert torch.allclose(values.mean(dim=0), setup.exposure.neutral(), atol=1e-5)
        drawn = state.states[STATE].tensors["count"]
        assert int(drawn.sum()) == sum(len(set(record.views)) for record in records)


@pytest.mark.sampled(12)
@pytest.mark.parametrize("row", DESIGN, ids=" x ".join)
def test_every_exposure_trains_with_every_backbone_and_number_of_views(row):
    check(row, FEW)


@pytest.mark.exposures
@pytest.mark.parametrize("row", ALL, ids=" x ".join)
def test_every_exposure_backbone_and_number_of_views_trains(row):
    check(row, MANY)
