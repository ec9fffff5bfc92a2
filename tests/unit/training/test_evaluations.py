"""When the held-out views are evaluated, and opacities are reset."""

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import evaluates_after


@pytest.mark.parametrize("views", [1, 2])
def test_default_evaluations_are_far_from_opacity_resets(views):
    config = RunConfig(steps=20_000, views=views, recipe={"name": "published"})
    setup = assemble(config, sample_scene(), "none")
    resets = [step for step in range(1, 20_000) if setup.schedule.resets(step)]
    found = [step for step in range(1, 20_000) if evaluates_after(setup, step)]
    assert len(found) == 10 and len(resets) >= 4
    assert not [(e, r) for e in found for r in resets if 0 <= e - r < 900]


@pytest.mark.parametrize(("steps", "given"), [(20_000, {"eval_every": 2000}), (2000, {})])
def test_default_evaluations_without_resets_are_at_multiples_of_a_tenth(steps, given):
    setup = assemble(RunConfig(steps=steps, **given), sample_scene(), "none")
    found = [step for step in range(1, steps + 1) if evaluates_after(setup, step)]
    assert found == list(range(steps // 10, steps, steps // 10))


@pytest.mark.parametrize(
    ("settings", "every"),
    [
        ({"steps": 20_000}, None),
        ({"steps": 20_000, "growth": "unbounded"}, 2000),
        ({"steps": 20_000, "max_gaussians": 10**6}, 2000),
        ({"steps": 20_000, "recipe": {"name": "published"}}, 2000),
        ({"steps": 20_000, "reset_every": 500}, 500),
        ({"steps": 30_000}, 3000),
        ({"steps": 9999, "growth": "unbounded"}, None),
    ],
    ids=str,
)
def test_opacities_are_reset_if_growth_is_unbounded_or_the_length_is_published(settings, every):
    assert assemble(RunConfig(**settings), sample_scene(), "none").schedule.reset_every == every
