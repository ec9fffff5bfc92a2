"""Contract checks for samplers."""

from dataclasses import replace
from functools import cache

import numpy as np

from crossgrad_core.contract.contexts import ViewSample
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.contract.slots.sampler import Sampler
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import SamplerRun, sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    admitted,
    cannot_tell,
    global_randomness_untouched,
    require,
    revived,
    same_state,
)
from crossgrad_core.testing.support.growth import require_bounded, size_of

#: Numbers of steps before and after an interruption of a run.
_BEFORE, _AFTER = 7, 12
#: Number of steps after which every training view must have been drawn. If a sampler draws one of
#: nine views at random, the probability that some view is missing after so many steps is below 9
#: (8/9)^400 < 1e-19.
_PATIENCE = 400


@cache
def _groups(grouping: str) -> tuple[str, ...]:
    scene = sample_scene()
    rule = build(Grouping, grouping, {})
    return rule.fit(scene, np.random.default_rng(0)).labels(scene.train_views)


def sampler_run(sampler: Sampler, views: int | None = None) -> SamplerRun:
    """Create a run of the sampler on the sample scene.

    If the sampler needs groups, the views have groups.
    """
    needed = sampler.default_grouping
    losses = np.random.default_rng(1).uniform(0.05, 0.3, len(sample_scene().train)).tolist()
    groups = None if needed is None else _groups(needed)
    return SamplerRun(sampler, sample_scene(), groups, views, losses=losses)


def default_views_are_admitted(make: Make[Sampler]) -> None:
    """The default number of views per step is a number that the sampler supports."""
    sampler = make()
    require(
        sampler.view_counts.admits(sampler.resolved_views),
        f"the default K is {sampler.resolved_views}, but the sampler needs {sampler.view_counts}",
    )


def draws_are_training_views(make: Make[Sampler]) -> None:
    """Each sample contains K positions of training views.

    A sample with labels contains K labels.
    """
    sampler = make()
    for views in admitted(sampler.view_counts):
        run = sampler_run(sampler, views)
        for _ in range(_AFTER):
            # Check the sample first, because `run.draw` works only with a valid sample.
            draw, _ = sampler.sample(run.context(), run.state)
            _require_good(draw, sampler.counts(views), len(run.scene.train))
            run.draw()


def _require_good(draw: ViewSample, counts: frozenset[int], available: int) -> None:
    require(
        isinstance(draw, ViewSample), f"the sampler returns {draw!r}, not a ViewSample and a state"
    )
    require(
        isinstance(draw.views, tuple) and all(type(view) is int for view in draw.views),
        f"the drawn views {draw.views!r} are not a tuple of plain integers",
    )
    views = len(draw.views)
    require(views in counts, f"{views} views were drawn, but `counts` contains {sorted(counts)}")
    require(
        all(0 <= view < available for view in draw.views),
        f"the drawn views {draw.views} are not all positions in 0 .. {available - 1}",
    )
    require(
        draw.labels is None or len(draw.labels) == views,
        f"{views} views were drawn with the labels {draw.labels}",
    )


def draws_hand_on_the_groups(make: Make[Sampler]) -> None:
    """If the training views have groups, every sample contains labels.

    Operators may need the labels.
    """
    sampler = make()
    if sampler.default_grouping is not None or sampler.own_labels:
        raise cannot_tell("it chooses its own groups")
    regimes = tuple(view.regime for view in sample_scene().train_views)
    run = replace(sampler_run(sampler), groups=regimes)
    for draw in run.draws(_AFTER):
        require(
            draw.labels is not None,
            "context.groups is set, but sample returns a ViewSample without labels, so "
            "that no operator knows the groups; expected a label for each view, such as "
            "context.groups[view]",
        )


def every_view_comes(make: Make[Sampler]) -> None:
    """Each training view is drawn at least once within a limited number of steps."""
    sampler = make()
    run = sampler_run(sampler)
    missing = set(range(len(run.scene.train)))
    for draw in run.draws(_PATIENCE):
        missing -= set(draw.views)
        if not missing:
            return
    require(
        not missing, f"the training views {sorted(missing)} were not drawn in {_PATIENCE} steps"
    )


def same_seed_same_draws(make: Make[Sampler]) -> None:
    """Samples depend only on the arguments, and random numbers come from `context.rng`."""
    with global_randomness_untouched():
        one = list(sampler_run(make()).draws(_AFTER))
        other = list(sampler_run(make()).draws(_AFTER))
    require(one == other, "two runs with the same seed draw different views")


def resumes_exactly(make: Make[Sampler]) -> None:
    """A resumed run draws the same views as an uninterrupted run."""
    whole, broken = sampler_run(make()), sampler_run(make())
    for _ in range(_BEFORE):
        whole.draw()
        broken.draw()
    broken.sampler, broken.state = make(), revived(broken.state)
    for step in range(_BEFORE + 1, _BEFORE + _AFTER + 1):
        one, other = whole.draw(), broken.draw()
        require(
            one == other,
            f"step {step}: an uninterrupted run draws {one.views}, a resumed run "
            f"{other.views}; keep all state in the returned state",
        )


def old_states_stay_untouched(make: Make[Sampler]) -> None:
    """`sample` returns a new state and does not change the previous state."""
    run = sampler_run(make())
    for _ in range(_BEFORE):
        old = run.state
        kept = revived(old)
        run.draw()
        require(same_state(old, kept), "sample changes the state that it received")


def states_stay_bounded(make: Make[Sampler]) -> None:
    """The state does not grow with the number of steps."""
    run = sampler_run(make())
    require_bounded((size_of(run.state) for _ in iter(run.draw, None)), "sample")


SAMPLER_CHECKS: tuple[Check[Sampler], ...] = (
    *COMPONENT_CHECKS,
    default_views_are_admitted,
    draws_are_training_views,
    draws_hand_on_the_groups,
    every_view_comes,
    same_seed_same_draws,
    resumes_exactly,
    old_states_stay_untouched,
    states_stay_bounded,
)
