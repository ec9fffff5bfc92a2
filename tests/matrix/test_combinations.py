"""Every sampler x operator x backbone runs, or is refused with a reason that is written down."""

from functools import cache
from itertools import product
from pathlib import Path

import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.errors import IncompatibleSelectionError
from crossgrad_core.registry import offers
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.assemble import assemble
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

REFUSALS = Path(__file__).with_name("refusals.txt")
STEPS = 3
#: Options without which a component has nothing to do.
NEEDED = {"chain": {"links": [{"name": "symmetric"}, {"name": "mean"}]}}


def ours(slot):
    """Our own names: an installed third-party plugin must not join our suite."""
    return sorted(entry.name for entry in offers(slot) if entry.distribution == "crossgrad")


COMBINATIONS = list(product(ours("samplers"), ours("operators"), ours("backbones")))


@cache
def scene():
    return sample_scene()


def choice(name):
    return ComponentChoice.model_validate({"name": name, **NEEDED.get(name, {})})


def assembled(sampler, operator, backbone):
    config = RunConfig(
        steps=200,
        sampler=choice(sampler),
        operator=choice(operator),
        backbone=choice(backbone),
    )
    return assemble(config, scene(), "none")


def trained(setup):
    state = first_state(setup)
    before = {name: tensor.detach().clone() for name, tensor in state.parameters.items()}
    records = [timed_step(setup, state) for _ in range(STEPS)]
    return before, state.parameters, [loss for record in records for loss in record.losses]


def refusals():
    lines = REFUSALS.read_text().splitlines()
    return dict(line.split(": ", 1) for line in lines if line)


def refused():
    found = {}
    for combination in COMBINATIONS:
        try:
            assembled(*combination)
        except IncompatibleSelectionError as error:
            found[" x ".join(combination)] = error.found
    return found


def test_exactly_the_written_combinations_are_refused_for_the_written_reason():
    assert refused() == refusals()


@pytest.mark.parametrize("combination", COMBINATIONS, ids=" x ".join)
def test_combination_trains_and_repeats(combination):
    if " x ".join(combination) in refusals():
        with pytest.raises(IncompatibleSelectionError):
            assembled(*combination)
        return
    setup = assembled(*combination)
    before, after, losses = trained(setup)
    assert all(loss == loss and abs(loss) < 10 for loss in losses)  # noqa: PLR0124
    assert all(torch.isfinite(tensor).all() for tensor in after.values())
    assert any(not torch.equal(before[name], after[name]) for name in before)
    _, again, same_losses = trained(setup)
    assert losses == same_losses
    assert all(torch.equal(after[name], again[name]) for name in after)
