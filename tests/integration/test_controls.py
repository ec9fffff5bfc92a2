"""Controls of learning rates and of density statistics: what they change, and nothing else."""

from dataclasses import replace
from math import prod, sqrt

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import BETAS, EPS, AdamRule, AdamState
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.recipe.table import short_lines
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import redecided
from crossgrad_core.run.settings import parsed
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.rates import (
    means_rate_at,
    rates_at,
    rule_at,
)
from crossgrad_core.training.rngs import STREAMS
from crossgrad_core.training.schedules import schedule_of
from crossgrad_core.training.start import first_state
from crossgrad_plugins.recipes import auto


def assembled(**settings):
    return assemble(parsed({"steps": 40, **settings}), sample_scene(), "none")


def messages_about(setup, setting):
    """The line of a decision, if the terminal shows it."""
    return [line for line in short_lines(setup.decisions) if line.startswith(f"{setting} ")]


def trained(number, *plugins, **settings):
    setup = assembled(**settings)
    for k, plugin in enumerate(plugins):
        setup.manager.register(plugin, name=f"watch{k}")
    state = first_state(setup)
    for _ in range(number):
        timed_step(setup, state)
    return setup, state


@pytest.mark.parametrize("backbone", ["vanilla", "scaffold"])
@pytest.mark.parametrize("step", [1, 20, 40])
def test_lr_factor_multiplies_every_learning_rate_of_the_backbone(backbone, step):
    plain, doubled = (
        assembled(
            backbone={"name": backbone},
            rate_factor=factor,
            rules={"lr-tail": False},
            beta1=0.9,
            beta2=0.999,
        )
        for factor in (1.0, 2.0)
    )
    published = {
        name: block.lr.at(step / 40) for block in plain.trained_blocks for name in block.tensors
    }
    assert rates_at(plain, step) == published and len(published) >= 5
    assert rates_at(doubled, step) == {name: 2.0 * rate for name, rate in published.items()}
    assert means_rate_at(doubled, step) == 2.0 * means_rate_at(plain, step)
    assert rule_at(doubled, step) == AdamRule()


#: What rates are multiplied by in an eighth of 30,000 steps.
EIGHTH = 8.0**0.45


@pytest.mark.parametrize(
    ("settings", "factor"),
    [
        ({"steps": 3_750}, EIGHTH),
        ({"steps": 30_000}, 1.0),
        ({"steps": 100_000}, 1.0),
        ({"steps": 5}, 6.3),
        ({"steps": 5, "beta2": 0.999}, 4.5),
        ({"steps": 1_000}, 4.5),
        ({"steps": 3_750, "views": 2}, EIGHTH),
        ({"max_views": 7_500, "views": 2, "steps": None}, EIGHTH),
        ({"steps": 3_750, "rate_factor": 0.5}, 0.5),
        ({"steps": 3_750, "recipe": {"name": "published"}}, 1.0),
        ({"steps": 3_750, "schedule": "absolute"}, 1.0),
        ({"steps": 9, "schedule": "absolute", "schedule_length": 3_750, "views": 1}, EIGHTH),
        ({"steps": 9, "schedule": "absolute", "schedule_length": 7_500, "views": 2}, EIGHTH),
    ],
)
def test_a_shorter_run_uses_larger_learning_rates(settings, factor):
    setup = assembled(**settings)
    published = {block.name: block.lr for block in setup.blocks}
    # Not so few views of nine photos that sizes have a rate of their own, but in runs of 5 steps.
    sizes = 2.0 if settings == {"steps": 5} else 1.0
    for name, own in (("opacities", 1.0), ("scales", sizes), ("f_rest", 1.0)):
        rate = own * factor * published[name].at(0)
        assert rates_at(setup, 1)[name] == pytest.approx(rate, rel=1e-9)
    told = messages_about(setup, "rate_factor")
    assert len(told) == (factor != 1.0 and "rate_factor" not in settings)
    assert all(f"rate_factor {factor:.3g}: " in line for line in told)


#: Views of a run that shows each of the nine training photos forty times.
PASSES = 360


@pytest.mark.parametrize(
    ("settings", "wait"),
    [
        ({"steps": 2_000, "views": 1}, 1_000),
        ({"steps": 1_000, "views": 2}, 1_000),
        ({"steps": 9_487, "views": 1}, 2_371),
        ({"steps": 30_000, "views": 1}, 0),
        ({"steps": 2_000, "recipe": {"name": "published"}}, 0),
        ({"steps": 2_000, "recipe": {"name": "published"}, "schedule_unit": "views"}, 0),
        ({"steps": 2_000, "schedule_unit": "steps"}, 0),
        ({"steps": 2_000, "schedule": "absolute"}, 0),
        ({"steps": 900, "schedule": "absolute", "schedule_length": 2_000, "views": 1}, 450),
        ({"steps": 2_000, "schedule": "absolute", "sh_start": 0.5}, 1_000),
        ({"steps": 2_000, "sh_from": 1, "views": 1}, 1_000),
        ({"steps": 2_000, "sh_start": 0.0}, 0),
        ({"steps": 2_000, "views": 1, "sh_start": 0.3}, 600),
        ({"steps": 2_000, "recipe": {"name": "published"}, "sh_start": 0.3}, 600),
        ({"steps": 2_000, "beta2": 0.999}, 0),
    ],
)
def test_sh_bands_start_at_half_of_a_short_run_with_few_passes(settings, wait, monkeypatch):
    monkeypatch.setattr(auto, "FEW_PASSES", 10_000)
    setup = assembled(**settings)
    schedule = setup.schedule
    assert schedule.sh_wait == pytest.approx(wait, abs=1)
    first = schedule.step_of(max(schedule.sh_wait, 3 * schedule.sh_interval))
    assert schedule.sh_degree(first) == 3
    if wait:
        before = schedule.step_of(schedule.sh_wait) - 1
        assert schedule.sh_degree(before) == settings.get("sh_from", 0)
    rows = [row for row in setup.decisions if row.setting == "sh_start" and row.override]
    assert len(rows) == (wait > 0 and "sh_start" not in settings)


def test_sh_bands_start_one_by_one_in_runs_with_many_passes():
    assert assembled(steps=PASSES, views=1).schedule.sh_wait == 0
    assert assembled(steps=PASSES - 2, views=1).schedule.sh_wait == (PASSES - 2) // 2
    # As it was planned, whatever the clock makes of it.
    planned = parsed({"steps": PASSES - 2, "views": 1})
    setup = assemble(planned, sample_scene(), "none")
    longer = setup.at_length(2 * PASSES, None)
    longer = schedule_of(longer.in_force, setup.densifier, 2 * PASSES, setup.schedule.counting)
    assert longer.sh_wait == PASSES


@pytest.mark.parametrize("settings", [{"backbone": {"name": "scaffold"}}, {"sh_from": 3}])
def test_sh_start_is_refused_if_no_sh_bands_are_left_to_add(settings, monkeypatch):
    monkeypatch.setattr(auto, "FEW_PASSES", 10_000)
    setup = assembled(sh_start=0.5, steps=2_000, **settings)
    with pytest.raises(UserError, match="sh_start"):
        refuse_settings_for_nothing(setup.config, setup)
    late = [row.setting for row in assembled(steps=2_000).decisions if row.override]
    none = [row.setting for row in assembled(steps=2_000, **settings).decisions if row.override]
    assert "sh_start" in late and "sh_start" not in none


def test_distance_weights_use_a_tenth_of_the_learning_rate_of_their_parameter():
    setup = assembled(backbone={"name": "distance"}, steps=5)
    found = {name: rate for name, rate in rates_at(setup, 1).items() if "distance_" in name}
    assert len(found) == 3
    plain = rates_at(setup, 1)
    for name, rate in found.items():
        assert rate == pytest.approx(0.1 * plain[name.removeprefix("distance_")], rel=1e-9), name


@pytest.mark.sampled(7)
@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize(
    ("length", "settings", "beta2"),
    [
        (PASSES - 2, {}, 0.98),
        (PASSES, {}, 0.999),
        (PASSES - 2, {"beta2": 0.9}, 0.9),
        (PASSES, {"beta2": 0.9}, 0.9),
        (PASSES - 2, {"schedule_unit": "steps"}, 0.98),
        (PASSES, {"schedule_unit": "steps"}, 0.999),
        (PASSES - 2, {"recipe": {"name": "published"}}, 0.999),
        (PASSES - 2, {"schedule": "absolute"}, 0.999),
        (PASSES - 2, {"rate_factor": 1.0}, 0.98),
    ],
)
def test_runs_with_few_passes_use_smaller_adam_betas(length, settings, beta2, views):
    setup = assembled(max_views=length, steps=None, views=views, **settings)
    assert len(setup.train_views) == 9
    first = 0.9 if {"recipe", "schedule"} & settings.keys() else 0.7
    assert all(rule_at(setup, step) == AdamRule((first, beta2)) for step in (1, length // views))
    told = messages_about(setup, "beta2")
    assert len(told) == (beta2 == 0.98)
    assert all("fewer than 40 views of each photo" in line for line in told)
    own = beta2 == 0.98 and "rate_factor" not in settings
    assert len(messages_about(setup, "few_pass_rates")) == own
    plain = setup.numbers.rate_factor * 5e-3
    assert rates_at(setup, 1)["scales"] == pytest.approx((2.0 if own else 1.0) * plain, rel=1e-9)


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    ("settings", "beta1"),
    [
        ({"steps": 5}, 0.7),
        ({"steps": 3_000}, 0.7),
        ({"steps": 1_500, "views": 2}, 0.7),
        ({"steps": 9_487}, 0.8),
        ({"steps": 4_743, "views": 2}, 0.8),
        ({"steps": None, "max_views": 9_487, "views": 1}, 0.8),
        ({"steps": 30_000}, 0.9),
        ({"steps": 90_000}, 0.9),
        ({"steps": 5, "recipe": {"name": "published"}}, 0.9),
        ({"steps": 5, "schedule": "absolute"}, 0.9),
        ({"steps": 5, "schedule": "absolute", "schedule_length": 2_000}, 0.7),
        ({"steps": 5, "batch_rule": "sqrt", "views": 2}, 0.8),
        ({"steps": 5, "backbone": {"name": "scaffold"}}, 0.9),
        ({"steps": 5, "backbone": {"name": "scaffold"}, "beta1": 0.5}, 0.5),
        ({"steps": 5, "backbone": {"name": "mip"}}, 0.7),
        ({"steps": 5, "beta1": 0.5}, 0.5),
        ({"steps": 30_000, "beta1": 0.0}, 0.0),
        ({"steps": 5, "beta1": 0.5, "recipe": {"name": "published"}}, 0.5),
    ],
)
def test_a_shorter_run_averages_the_first_moment_over_fewer_steps(settings, beta1):
    setup = assembled(**{"views": 1, **settings})
    for step in (1, 5):
        assert rule_at(setup, step).betas[0] == pytest.approx(beta1, abs=1e-4)
    told = messages_about(setup, "beta1")
    ours = "beta1" not in settings and "batch_rule" not in settings and beta1 < 0.9
    assert len(told) == ours
    assert all(f"beta1 {beta1:.3g}: " in each and "=0.9)" in each for each in told)


@pytest.mark.parametrize("steps", [60, 5_000])
@pytest.mark.parametrize("views", [2, 5, 10])
def test_the_batch_rule_averages_beta2_over_the_same_number_of_steps(steps, views, monkeypatch):
    monkeypatch.setattr(auto, "FEW_PASSES", 10_000)
    setup = assembled(steps=steps, views=views, batch_rule="sqrt")
    first, second = rule_at(setup, 1).betas
    if steps * views < 30_000:
        assert 1 / (1 - second) == pytest.approx(max(50, steps / 50))
        assert first == pytest.approx(1 - 0.1 * views)
    else:
        assert 1 / (1 - second) == pytest.approx(1_000 / views)


@pytest.mark.parametrize(("planned", "beta2"), [(PASSES - 1, 0.98), (PASSES, 0.999)])
@pytest.mark.parametrize("steps", [PASSES // 2, PASSES * 2])
def test_the_planned_adam_betas_do_not_change_when_the_clock_changes_the_length(
    planned, beta2, steps
):
    setup = assembled(steps=planned)
    setup = replace(setup, schedule=replace(setup.schedule, total=steps)).at_length(steps, None)
    assert rule_at(setup, 1) == AdamRule((0.7, beta2))
    power, most = (0.65, 6.3) if beta2 == 0.98 else (0.45, 4.5)
    assert setup.numbers.rate_factor == min(most, (30_000 / steps) ** power)


def test_runs_with_few_passes_average_the_second_moment_over_a_share_of_the_steps(monkeypatch):
    monkeypatch.setattr(auto, "FEW_PASSES", 10_000)
    for steps, memory in ((2_000, 50), (5_000, 100), (29_999, 599.98), (30_000, 1_000)):
        setup = assembled(steps=steps)
        assert rule_at(setup, 1).betas[1] == pytest.approx(1 - 1 / memory, abs=1e-12)
        assert setup.numbers.rate_factor == pytest.approx(min(6.3, (30_000 / steps) ** 0.65))


def test_learning_rates_follow_the_planned_length_in_runs_with_a_time_budget():
    setup = assembled(steps=None, seconds=60.0)
    for name in ("rate_factor", "beta1", "beta2"):
        (row,) = (row for row in setup.decisions if row.setting == name)
        assert row.because == "decided when the length is planned" and not row.override
    planned = redecided(setup, 3_750)
    published, now = (rates_at(each, 1)["opacities"] for each in (setup, planned))
    assert now == pytest.approx(EIGHTH * published)
    assert messages_about(planned, "rate_factor")
    own = redecided(assembled(steps=None, seconds=60.0, rate_factor=2.0), 3_750)
    assert own.numbers.rate_factor == 2.0 and not messages_about(own, "rate_factor")


def test_rate_factor_multiplies_the_first_step():
    start = first_state(assembled()).parameters
    one, three = (trained(1, rate_factor=f)[1].parameters for f in (1.0, 3.0))
    for name in ("scales", "opacities", "f_dc"):
        moved, farther = ((each[name] - start[name]).detach().abs() for each in (one, three))
        assert float(moved.max()) > 0
        assert torch.allclose(farther, 3 * moved, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("views", [2, 4, 10])
def test_the_batch_rule_scales_with_the_number_of_views(views):
    setup, plain = (
        assembled(views=views, batch_rule=rule, beta2=0.999) for rule in ("sqrt", "none")
    )
    for step in (1, 7, 40):
        rule = rule_at(setup, step)
        assert rule.betas == pytest.approx([1 - views * (1 - beta) for beta in BETAS], abs=1e-15)
        assert (rule.eps, rule.age) == (EPS / sqrt(views), 1.0)
        wanted = {name: sqrt(views) * rate for name, rate in rates_at(plain, step).items()}
        assert rates_at(setup, step) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.slow
def test_adam_under_the_batch_rule_agrees_with_torch():
    rng = torch.Generator().manual_seed(3)
    start = torch.randn(50, generator=rng)
    rule, rate = AdamRule.for_views(4), 1e-2 * 2.0
    theirs = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=rate, betas=rule.betas, eps=rule.eps)
    ours, state = {"x": start.clone()}, AdamState()
    for _ in range(20):
        theirs.grad = torch.randn(50, generator=rng)
        adam_step(ours, {"x": theirs.grad.clone()}, state, {"x": rate}, rule)
        optimizer.step()
    assert torch.allclose(ours["x"], theirs.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("plan", ["1..2@0.5", "4..1@0.3"])
def test_bias_correction_counts_all_steps_so_far_when_k_changes(plan):
    setup = assembled(views=plan, steps=600, batch_rule="sqrt")
    for step in (100, 310, 600):
        rule = rule_at(setup, step)
        for index in (0, 1):
            betas = (rule_at(setup, each).betas[index] for each in range(1, step + 1))
            wanted = 1.0 - prod(betas)
            assert 1.0 - rule.betas[index] ** (step * rule.age) == pytest.approx(wanted, rel=0.01)


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"views": 1, "batch_rule": "sqrt"}, "batch_rule"),
        ({"views": 1, "densify_views": "one"}, "densify_views"),
        ({"views": 2, "densify_views": "extra", "densifier": {"name": "mcmc"}}, "densify_views"),
        ({"views": 2, "densify_views": "one", "densifier": {"name": "none"}}, "densify_views"),
        ({"schedule_length": 600}, "schedule_length"),
    ],
)
def test_a_training_setting_without_effect_is_refused(settings, name):
    config = parsed({"steps": 40, **settings})
    with pytest.raises(UserError, match=f"have no effect(.|\n)*{name}"):
        refuse_settings_for_nothing(config, assembled(**settings))


def test_the_batch_rule_is_refused_for_more_than_ten_views():
    with pytest.raises(IncompatibleSelectionError, match="at most K = 10 views; K is 11"):
        assembled(views=11, batch_rule="sqrt")


class Observed:
    """Keeps which views density control got."""

    def __init__(self):
        self.drawn, self.got, self.shares = [], [], []

    @hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        answer = yield
        self.drawn.append(answer.draw.views)
        return answer

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        self.got.append(tuple(view.index for view in context.views))
        self.shares.append(context.share)
        assert all(view.screen.mean_gradient is not None for view in context.views)
        return (yield)


def test_densify_views_one_uses_one_view_per_step_at_alternating_positions():
    seen = Observed()
    _, state = trained(12, seen, views=3, densify_views="one")
    assert seen.got == [(views[(k + 1) % 3],) for k, views in enumerate(seen.drawn)]
    assert seen.shares == [1 / 3] * 12
    assert (state.counters.views, state.counters.backward_passes) == (36, 36)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("views", [1, 2])
def test_an_extra_view_is_rendered_while_density_control_lasts(views):
    seen = Observed()
    asked = {"views": views, "min_refinements": 6}
    setup, state = trained(40, seen, densify_views="extra", **asked)
    last = 20  # of 40: density control ends in the middle
    assert [setup.schedule.collects(step) for step in (last - 1, last + 1)] == [True, False]
    extra = sum(map(setup.schedule.collects, range(1, 41)))
    assert [len(got) - views for got in seen.got] == [1] * extra + [0] * (40 - extra)
    assert [got[:views] for got in seen.got] == seen.drawn
    assert seen.shares == [(views + 1) / views] * extra + [1.0] * (40 - extra)
    assert state.counters.views == state.counters.backward_passes == 40 * views + extra
    assert len({got[views] for got in seen.got[:extra]}) > 4


@pytest.mark.parametrize("views", [1, 2])
def test_no_extra_view_is_rendered_if_no_edit_follows(views):
    setup, state = trained(12, views=views, densify_views="extra")
    assert setup.schedule.collects(12) and not setup.schedule.grows
    assert state.counters.views == 12 * views


class Weighing:
    """Weighs pixels by random numbers."""

    @hookimpl
    def crossgrad_pixel_weights(self, context):
        shape = (context.camera.height, context.camera.width)
        return torch.from_numpy(context.rng.random(shape, dtype=np.float32))


class WeighingBy:
    """Weighs pixels by what it is given."""

    def __init__(self, change):
        self.change = change

    @hookimpl
    def crossgrad_pixel_weights(self, context):
        return self.change(torch.ones(context.camera.height, context.camera.width))


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda ones: ones - 1.5, "the least -0.5"),
        (lambda ones: ones.index_fill(1, torch.tensor([2]), torch.nan), "the least nan"),
        (lambda ones: ones / 0.0, "the least inf"),
        (lambda ones: ones[:-1], "torch.float32"),
        (lambda ones: ones.int(), "torch.int32"),
        (lambda ones: ones.numpy(), "ndarray"),
    ],
    ids=["negative", "NaN", "infinite", "a row short", "whole numbers", "an array of NumPy"],
)
def test_pixel_weights_that_no_loss_can_use_are_refused(change, found):
    with pytest.raises(UserError, match="invalid pixel weights") as refused:
        trained(1, WeighingBy(change))
    assert found in refused.value.found
    assert refused.value.where.startswith("hook crossgrad_pixel_weights of watch0, photo ")


@pytest.mark.sampled(2)
@pytest.mark.parametrize("operator", ["sum", "pcgrad"])
@pytest.mark.parametrize("choice", ["one", "extra"])
def test_densify_views_changes_no_bit_before_the_first_edit(choice, operator):
    settings = {"views": 2, "steps": 400, "operator": {"name": operator}, "min_refinements": 6}
    (setup, state), (_, other) = (
        trained(8, Weighing(), densify_views=each, background="random", **settings)
        for each in ("all", choice)
    )
    assert setup.schedule.first_edit > 8 and setup.weighs
    assert other.counters.views == 16 + 8 * (choice == "extra")
    assert all(torch.equal(t, other.parameters[n]) for n, t in state.parameters.items())
    for n, moment in state.adam.exp_avg_sq.items():
        assert torch.equal(moment, other.adam.exp_avg_sq[n])
    for name in set(STREAMS) - {"density"}:
        rngs = (each.rngs[name].bit_generator.state for each in (state, other))
        assert next(rngs) == next(rngs)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("choice", ["one", "extra"])
def test_densify_views_changes_the_edits_of_density_control(choice):
    asked = {"views": 2, "min_refinements": 6}
    edited = [trained(40, densify_views=each, **asked)[1] for each in ("all", choice)]
    shapes = [state.parameters["means"].shape[0] for state in edited]
    sums = [float(state.parameters["means"].detach().sum()) for state in edited]
    assert shapes[0] != shapes[1] or sums[0] != sums[1]
