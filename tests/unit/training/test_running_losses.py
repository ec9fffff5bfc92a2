"""Running losses know the scale that they were taken at."""

from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.contract.blocks import EMPTY_STATE, PluginState
from crossgrad_core.contract.slots.resolution import octave
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.samplers import sampler_run


@pytest.mark.parametrize(
    ("scale", "expected"), [(1.0, 0), (0.75, 0), (0.7, -1), (0.5, -1), (0.36, -1), (0.25, -2)]
)
def test_scale_octaves_are_the_nearest_powers_of_two(scale, expected):
    assert octave(scale) == expected


def active_after(*steps):
    """The state of `active` after steps in which view 0 had (loss, scale)."""
    sampler = build("samplers", "active", {})
    run = sampler_run(sampler)
    context = run.context()
    state = EMPTY_STATE
    for loss, scale in steps:
        record = _record(loss, scale)
        _, state = sampler.sample(replace(context, last=record), state)
    return state.values


def _record(loss, scale):
    from crossgrad_core.contract.contexts import StepRecord

    scales = () if scale == 1.0 else (scale,)
    return StepRecord(1, (0,), ("a",), None, (loss,), 40, {}, 0.1, scales)


def test_active_restarts_the_running_loss_of_a_view_when_its_scale_octave_changes():
    assert active_after((0.4, 1.0), (0.2, 1.0))["losses"]["0"] == pytest.approx(0.38)
    half = active_after((0.4, 1.0), (0.2, 0.5))
    assert half["losses"]["0"] == 0.2
    assert half["octaves"] == {"0": -1}
    assert active_after((0.4, 1.0), (0.2, 0.5), (0.1, 0.5))["losses"]["0"] == pytest.approx(0.19)
    back = active_after((0.4, 1.0), (0.2, 0.5), (0.3, 1.0))
    assert back["losses"]["0"] == 0.3
    assert "octaves" not in back


def gradnorm_rates(*steps):
    """The relative losses of groups a and b after steps of (loss of a, loss of b, scale of a)."""
    operator = build("operators", "gradnorm", {"baseline": 2, "decay": 0.0})
    losses = {}
    for a, b, scale in steps:
        context = _Context(np.array([a, b]), (scale, 1.0))
        losses = operator._followed(losses, ("a", "b"), context)
    return operator._rates(losses).tolist(), losses


class _Context:
    def __init__(self, losses, scales):
        self.losses, self.scales = losses, scales


def test_gradnorm_compares_with_the_loss_at_the_start_of_the_same_octave():
    full = [(0.4, 0.4, 1.0), (0.4, 0.4, 1.0)]
    assert gradnorm_rates(*full, (0.2, 0.4, 1.0))[0] == pytest.approx([0.5, 1.0])
    # Two losses at half size are the start there; before, nothing can be said.
    assert gradnorm_rates(*full, (0.1, 0.4, 0.5))[0] == [1.0, 1.0]
    half = [(0.1, 0.4, 0.5), (0.1, 0.4, 0.5)]
    assert gradnorm_rates(*full, *half, (0.08, 0.4, 0.5))[0] == pytest.approx([0.8, 1.0])
    # What was followed at full size is still there.
    assert gradnorm_rates(*full, *half, (0.2, 0.4, 1.0))[0] == pytest.approx([0.5, 1.0])


def test_at_full_size_the_state_of_gradnorm_has_no_additional_entries():
    _, losses = gradnorm_rates((0.4, 0.4, 1.0))
    assert losses["a"].keys() == {"count", "start", "average"}
    assert PluginState({"losses": losses})
