"""Each view is drawn as often as the sampler promises."""

import numpy as np
import pytest
from scipy.stats import chisquare

from crossgrad_core.testing.fixtures import SamplerRun, posed_scene, posed_view
from crossgrad_plugins.samplers.active import Active
from crossgrad_plugins.samplers.anchors_30 import Anchors30
from crossgrad_plugins.samplers.balanced import NearFar, RandomSplit, ThreeWay
from crossgrad_plugins.samplers.fps import FarthestPoint
from crossgrad_plugins.samplers.horizon import Horizon
from crossgrad_plugins.samplers.uniform import Epoch, Random

STEPS = 1500
UNEQUAL = ("near",) * 3 + ("far",) * 6
THREE = ("near",) * 2 + ("middle",) * 3 + ("far",) * 4


def scene():
    rng = np.random.default_rng(1)
    return posed_scene([posed_view(p, f"{i}.png") for i, p in enumerate(rng.normal(size=(9, 3)))])


def balanced(groups):
    """Equal shares of the groups, uniform within each."""
    labels = list(dict.fromkeys(groups))
    return np.array([1.0 / len(labels) / groups.count(label) for label in groups])


UNIFORM = np.full(9, 1 / 9)
CASES = {
    "random": (Random(), None, 2, UNIFORM),
    "random one view": (Random(), None, 1, UNIFORM),
    "random distinct": (Random(distinct=True), None, 4, UNIFORM),
    "near-far": (NearFar(), UNEQUAL, 2, balanced(UNEQUAL)),
    "near-far four": (NearFar(), UNEQUAL, 4, balanced(UNEQUAL)),
    "near-far distinct": (NearFar(order="distinct"), UNEQUAL, 4, balanced(UNEQUAL)),
    "near-far alternating": (NearFar(alternating=True), UNEQUAL, 1, balanced(UNEQUAL)),
    "three-way": (ThreeWay(), THREE, 3, balanced(THREE)),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("case", CASES)
def test_views_are_drawn_with_the_promised_probability(case):
    sampler, groups, k, expected = CASES[case]
    run = SamplerRun(sampler, scene(), groups, k)
    counts = np.bincount([v for draw in run.draws(STEPS) for v in draw.views], minlength=9)
    assert chisquare(counts, expected * counts.sum()).pvalue > 1e-3


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "case", ["random", "random distinct", "near-far", "near-far four", "three-way"]
)
def test_the_uniformity_check_detects_a_bias(case):
    sampler, groups, k, expected = CASES[case]
    run = SamplerRun(sampler, scene(), groups, k)
    counts = np.bincount([v for draw in run.draws(STEPS) for v in draw.views], minlength=9)
    biased = expected * np.where(np.arange(9) == 0, 1.3, 1.0)
    assert chisquare(counts, biased / biased.sum() * counts.sum()).pvalue < 1e-3


@pytest.mark.parametrize("k", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("sampler", [Epoch(), FarthestPoint()])
def test_an_epoch_contains_every_view_once(sampler, k):
    run = SamplerRun(sampler, scene(), views_per_step=k)
    order = [view for draw in run.draws(9 * 4) for view in draw.views]
    epochs = np.array(order[: len(order) // 9 * 9]).reshape(-1, 9)
    assert (np.sort(epochs, axis=1) == np.arange(9)).all()


@pytest.mark.parametrize("k", [2, 4, 5, 9])
@pytest.mark.parametrize("sampler", [Epoch(), FarthestPoint(), Random(distinct=True)])
def test_the_views_of_a_step_are_different(sampler, k):
    run = SamplerRun(sampler, scene(), views_per_step=k)
    assert all(len(set(draw.views)) == k for draw in run.draws(60))


def test_epochs_start_at_any_view_and_differ():
    run = SamplerRun(Epoch(), scene())
    epochs = [tuple(draw.views[0] for draw in run.draws(9)) for _ in range(300)]
    assert len(set(epochs)) > 290
    starts = np.bincount([epoch[0] for epoch in epochs], minlength=9)
    assert chisquare(starts).pvalue > 1e-3


def test_independent_draws_repeat_a_view_in_one_of_nine_steps():
    run = SamplerRun(Random(), scene())
    repeats = sum(len(set(draw.views)) == 1 for draw in run.draws(STEPS))
    assert chisquare([repeats, STEPS - repeats], [STEPS / 9, STEPS * 8 / 9]).pvalue > 1e-3


def test_near_and_far_views_of_a_pair_are_independent():
    run = SamplerRun(NearFar(), scene(), UNEQUAL)
    table = np.zeros((3, 6))
    for draw in run.draws(STEPS):
        table[draw.views[0], draw.views[1] - 3] += 1
    assert chisquare(table.ravel()).pvalue > 1e-3


def test_near_far_in_epochs_uses_every_near_view_before_any_is_repeated():
    run = SamplerRun(NearFar(order="epoch"), scene(), UNEQUAL)
    near = [draw.views[0] for draw in run.draws(30)]
    assert all(sorted(near[i : i + 3]) == [0, 1, 2] for i in range(0, 30, 3))


def test_anchors_pair_near_with_far_views_and_middle_with_middle_views():
    run = SamplerRun(Anchors30(), scene(), THREE)
    pairs = {draw.labels for draw in run.draws(300)}
    assert pairs == {("near", "far"), ("far", "near"), ("middle", "middle")}
    first = np.bincount([draw.views[0] for draw in run.draws(STEPS)], minlength=9)
    assert chisquare(first).pvalue > 1e-3


@pytest.mark.parametrize("k", [1, 2, 3])
def test_the_horizon_sampler_keeps_its_ratios_exactly(k):
    run = SamplerRun(Horizon(), scene(), UNEQUAL, k, steps=200)
    coarse = [label for draw in run.draws(120) for label in draw.labels]
    fine = [label for draw in run.draws(80) for label in draw.labels]
    assert coarse.count("far") == 2 * coarse.count("near")
    assert fine.count("far") == fine.count("near")
    assert coarse[:6] == ["far", "far", "near"] * 2


@pytest.mark.sampled(11)
@pytest.mark.parametrize("percent", range(1, 100))
def test_the_horizon_sampler_completes_its_first_stage(percent):
    # All of it far, then all near: 0.29 of 100 steps are 29, though not in binary numbers.
    sampler = Horizon(coarse=(99, 1), fine=(1, 99), coarse_share=percent / 100)
    run = SamplerRun(sampler, scene(), UNEQUAL, 1, steps=100)
    labels = [label for draw in run.draws(100) for label in draw.labels]
    assert labels[:percent] == ["far"] * percent
    assert labels[percent : percent + 2] == ["far", "near"][: 100 - percent]


def test_the_horizon_sampler_uses_every_view_of_a_group_before_any_is_repeated():
    run = SamplerRun(Horizon(coarse=(1, 1)), scene(), UNEQUAL)
    far = [draw.views[0] for draw in run.draws(48) if draw.labels == ("far",)]
    assert all(sorted(far[i : i + 6]) == [3, 4, 5, 6, 7, 8] for i in range(0, 24, 6))


@pytest.mark.slow
def test_random_halves_are_drawn_once_and_do_not_depend_on_the_groups():
    halves = set()
    for seed in range(200):
        run = SamplerRun(RandomSplit(), scene(), UNEQUAL, rng=np.random.default_rng(seed))
        members = {"first": set(), "second": set()}
        for draw in run.draws(40):
            for view, label in zip(draw.views, draw.labels, strict=True):
                members[label].add(view)
        assert members["first"].isdisjoint(members["second"])
        halves.add(frozenset(members["first"]))
    assert len(halves) > 60


def test_the_active_sampler_renders_every_view_before_it_compares_losses():
    run = SamplerRun(Active(), scene(), UNEQUAL)
    seen = [view for draw in run.draws(6) for view in draw.views]
    assert set(seen) == set(range(9))


def test_the_active_sampler_prefers_the_partner_with_the_largest_disparity():
    losses = [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.9]
    run = SamplerRun(Active(), scene(), UNEQUAL, losses=losses)
    list(run.draws(50))
    partners = [draw.views[1] for draw in run.draws(400) if draw.labels[0] == "near"]
    counts = np.bincount(partners, minlength=9)
    # Scores 0.8 and five zeros: the softmax over their standard deviation gives 0.745.
    scores = np.array([0.0] * 5 + [0.8])
    weights = np.exp(scores / scores.std())
    expected = weights / weights.sum() * counts.sum()
    assert counts[:3].sum() == 0
    assert chisquare(counts[3:], expected).pvalue > 1e-3


def test_the_active_sampler_uses_the_top_candidates_only():
    losses = [0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    run = SamplerRun(Active(top=2), scene(), UNEQUAL, losses=losses)
    list(run.draws(100))
    partners = {draw.views[1] for draw in run.draws(300) if draw.labels[0] == "near"}
    assert partners == {7, 8}


def test_the_active_sampler_averages_the_losses_of_a_view():
    run = SamplerRun(Active(decay=0.5), scene(), UNEQUAL, losses=[1.0] * 9)
    list(run.draws(20))
    run.losses = [3.0] * 9
    draw = run.draw()
    run.losses = [0.0] * 9
    run.draw()
    assert {run.state.values["losses"][str(view)] for view in draw.views} == {2.0}


def test_the_active_sampler_ignores_a_non_finite_loss():
    run = SamplerRun(Active(), scene(), UNEQUAL, losses=[float("nan")] * 9)
    list(run.draws(20))
    assert run.state.values["losses"] == {}
