"""Contract checks for resolutions."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import ScaleContext, StepRecord, ViewSample
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.slots.resolution import Resolution
from crossgrad_core.testing.fixtures import STEPS, sample_scene, step_fields
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    global_randomness_untouched,
    require,
    revived,
    same_state,
)
from crossgrad_core.testing.support.growth import require_bounded, size_of

#: Steps that are checked, evenly spread over a run of the published length.
_STEPS = tuple(range(1, STEPS + 1, STEPS // 40))
_BREAK = 20


@dataclass
class _Run:
    """A resolution that is called step by step, as in a training run."""

    resolution: Resolution
    state: PluginState = field(default_factory=PluginState)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    last: StepRecord | None = None

    def take_step(self, step: int) -> tuple[float, ...]:
        draw = _draw(step)
        context = ScaleContext(**{**step_fields(step), "rng": self.rng}, draw=draw, last=self.last)
        scales, self.state = self.resolution.scales(context, self.state)
        names = tuple(view.name for view in context.views)
        losses = (0.2,) * len(names)
        self.last = StepRecord(step, draw.views, names, None, losses, 40, {}, 0.01 * step, scales)
        return scales


def _draw(step: int) -> ViewSample:
    count = len(sample_scene().train)
    return ViewSample(tuple((step + 3 * slot) % count for slot in range(1 + step % 4)))


def every_view_has_a_scale(make: Make[Resolution]) -> None:
    """For any number of drawn views, each view gets a scale above 0 and at most 1."""
    run = _Run(make())
    for step in _STEPS:
        scales = run.take_step(step)
        views = len(_draw(step).views)
        good = isinstance(scales, tuple) and all(isinstance(scale, float) for scale in scales)
        require(good, f"scales() returns {scales!r}, not a tuple of floats")
        require(
            len(scales) == views, f"{views} views were drawn but {len(scales)} scales were returned"
        )
        require(all(0.0 < scale <= 1.0 for scale in scales), f"scales {scales} are not in (0, 1]")


def same_seed_same_scales(make: Make[Resolution]) -> None:
    """Scales depend only on the arguments, and random numbers come from `context.rng`."""
    with global_randomness_untouched():
        one, other = (
            [run.take_step(step) for step in _STEPS] for run in (_Run(make()), _Run(make()))
        )
    require(one == other, "two runs with the same seed have different scales")


def resumes_exactly(make: Make[Resolution]) -> None:
    """A resumed run has the same scales as an uninterrupted run."""
    whole, broken = _Run(make()), _Run(make())
    for number, step in enumerate(_STEPS):
        if number == _BREAK:
            broken.resolution, broken.state = make(), revived(broken.state)
        one, other = whole.take_step(step), broken.take_step(step)
        require(
            one == other,
            f"step {step}: an uninterrupted run has the scales {one}, a resumed run "
            f"{other}; keep all state in the returned state",
        )


def old_states_stay_untouched(make: Make[Resolution]) -> None:
    """`scales` returns a new state and does not change the previous state."""
    run = _Run(make())
    for step in _STEPS:
        old = run.state
        kept = revived(old)
        run.take_step(step)
        require(same_state(old, kept), "scales changes the state that it received")


def states_stay_bounded(make: Make[Resolution]) -> None:
    """The state does not grow with the number of steps."""
    run = _Run(make())
    require_bounded(
        (size_of(run.state) for step in range(1, STEPS) if run.take_step(step)), "scales"
    )


def pixels_add_up(make: Make[Resolution]) -> None:
    """A step with one view counts more than 0 pixels and at most the pixels of a full-size view."""
    resolution, schedule = make().fitted_to(sample_scene()), Schedule.for_run(STEPS)
    for before, after in pairwise((0, *_STEPS)):
        pixels = resolution.pixels(schedule, after) - resolution.pixels(schedule, before)
        message = (
            f"pixels() increases by {pixels} from step {before} to step {after}, with one "
            "view per step"
        )
        require(0.0 < pixels <= after - before + 1e-6 * after, message)


RESOLUTION_CHECKS: tuple[Check[Resolution], ...] = (
    *COMPONENT_CHECKS,
    every_view_has_a_scale,
    same_seed_same_scales,
    resumes_exactly,
    old_states_stay_untouched,
    states_stay_bounded,
    pixels_add_up,
)
