"""How many steps fit into a budget of training seconds."""

from types import SimpleNamespace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.registry import build
from crossgrad_core.training.start import _fitting


def setup(densifier="adc"):
    return SimpleNamespace(
        config=RunConfig(),
        densifier=build("densifiers", densifier, {}),
        selection=SimpleNamespace(names={"densifier": densifier}),
    )


@pytest.mark.parametrize(
    ("affordable", "steps"),
    [
        (0.3, 1),
        (400.0, 400),  # too short for density control: nothing grows
        (1250.0, 1201),  # the longest run that does not grow
        (1500.0, 1250),  # one edit: every step costs 1.2 times as much
        (18_000.0, 9000),  # twice as much at the most
    ],
)
def test_growth_is_paid_for_only_where_it_happens(affordable, steps):
    assert _fitting(setup(), affordable) == steps


def test_without_density_control_every_step_costs_the_same():
    assert _fitting(setup("none"), 18_000.0) == 18_000
