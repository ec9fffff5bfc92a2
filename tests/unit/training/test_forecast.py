"""A run of so many steps says after the first ones how long it takes."""

from dataclasses import make_dataclass
from types import SimpleNamespace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.registry.entries import build
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.run.finish import LOOK_STEPS, Forecast
from crossgrad_core.run.results.log import roughly
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.budget import COST_PER_EDIT, COUNTED_EDITS, Planned
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.state import Clock

RUN = make_dataclass(
    "Run",
    [
        "config",
        "in_force",
        "numbers",
        "revised",
        "densifier",
        "selection",
        "schedule",
        "hook",
        "notes",
        "pixel_share",
        "trained_blocks",
    ],
    frozen=True,
)


def texts(each, steps, densifier="adc", first=0, wait=0.0, revisions=()):
    """What a run says whose steps take `each` seconds, the first one `wait` more."""
    said, revised = [], []
    hook = SimpleNamespace(
        crossgrad_log=lambda text: said.append((state.step, text)),
        crossgrad_length_changed=lambda step, total: revised.append((step, total)),
    )
    config, _, _ = with_decisions(RunConfig(steps=steps, growth="unbounded"), sample_scene())
    run = RUN(
        config=config,
        in_force=config,
        numbers=Numbers.of(config),
        revised={},
        densifier=build("densifiers", densifier, {}),
        selection=SimpleNamespace(
            names={"densifier": densifier}, resolution=build("resolutions", "full", {})
        ),
        schedule=Schedule.for_run(steps),
        hook=hook,
        notes=(),
        pixel_share=0.6,
        trained_blocks=(),
    )
    length = Forecast(Planned(revisions))
    state = SimpleNamespace(
        step=first,
        clock=Clock(train=100.0 * bool(first) + wait),
        states={},
        primitives=lambda setup: 1000,
    )
    for _ in range(min(steps - first - 1, 200)):
        state.step += 1
        state.clock.train += each
        if length.due(state):
            run = length.revised(run, state)
    return said


def test_the_expected_duration_of_a_default_run_is_reported_once_with_a_remedy():
    ((step, text),) = texts(0.1, 30_000, wait=60.0)  # a slow first step is not taken for the rest
    hours = (30_000 - step) * 0.1 * (1.0 + COST_PER_EDIT * COUNTED_EDITS) / 3600
    assert 1.6 < hours < 1.7
    assert f"{30_000 - step:,} steps take about 100 min" in text
    assert "one step takes 100 ms now, including growth" in text and "--seconds S" in text


def test_the_expected_duration_without_density_control_includes_no_growth():
    ((step, text),) = texts(1.0, 30_000, "none")
    assert step == 1 + LOOK_STEPS
    assert "the remaining 29,996 steps take about 8 h 20 min (one step takes 1000 ms now)" in text


def test_a_resumed_run_reports_the_remaining_time():
    ((_, text),) = texts(1.0, 30_000, "none", first=29_000)
    assert "the remaining 996 steps take about 17 min" in text


def test_a_short_run_reports_no_expected_duration():
    assert texts(0.01, 900) == []
    assert texts(0.01, 900, revisions=((20, 800),)) == []


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(61, "1 min"), (7100, "118 min"), (7200, "2 h 00 min"), (360_000, "100 h 00 min")],
)
def test_estimated_durations_are_rounded(seconds, text):
    assert roughly(seconds) == f"about {text}"
