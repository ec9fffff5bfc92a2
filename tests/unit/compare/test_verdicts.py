"""Interquartile means, intervals, Holm's correction, the three verdicts."""

from itertools import pairwise
from math import inf, isnan, nan, sqrt

import numpy as np
import pytest
from scipy.stats import trim_mean, ttest_1samp
from support.run_folders import RunFolder

from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.statistics import (
    IQM,
    MEAN,
    Bootstrap,
    Verdict,
    estimate,
    holm,
    iqm,
    opposed,
    pairs_needed,
    verdicts,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("count", [4, 8, 12, 40])
def test_the_interquartile_mean_equals_scipys_if_quarters_are_whole_numbers(count):
    values = RNG.standard_t(2, (3, count))
    assert iqm(values) == pytest.approx(trim_mean(values, 0.25, axis=1))


@pytest.mark.parametrize(
    ("values", "expected"),
    [([5.0], 5.0), ([1.0, 2.0], 1.5), ([0.0, 3.0, 90.0], (0.25 * 0 + 3 + 0.25 * 90) / 1.5)],
)
def test_the_interquartile_mean_of_few_values_is_correct(values, expected):
    assert iqm(np.array(values)) == pytest.approx(expected)


def test_with_fewer_than_ten_pairs_verdicts_use_students_t_test():
    values = RNG.normal(0.1, 0.2, 7)
    found = estimate(values, ["a"] * 7, 0.1)
    peer = ttest_1samp(values, 0.0)
    assert found.method == MEAN
    assert found.p_different == pytest.approx(peer.pvalue)
    assert found.wide == pytest.approx(tuple(peer.confidence_interval(0.95)))
    assert found.narrow == pytest.approx(tuple(peer.confidence_interval(0.90)))
    greater = ttest_1samp(values, -0.1, alternative="greater").pvalue
    less = ttest_1samp(values, 0.1, alternative="less").pvalue
    assert found.p_equivalent == pytest.approx(max(greater, less))


def test_with_ten_or_more_pairs_verdicts_use_a_widened_bootstrap_interval():
    values = RNG.normal(0.1, 0.2, 16)
    found = estimate(values, ["a"] * 16, 0.1)
    assert found.method == IQM
    assert found.center == pytest.approx(trim_mean(values, 0.25))
    drawn = np.random.default_rng(1).choice(values, (9999, 16))
    low, high = np.quantile(trim_mean(drawn, 0.25, axis=1), [0.025, 0.975])
    assert 1.05 < (found.wide[1] - found.wide[0]) / (high - low) < 1.4
    assert found == estimate(values, ["a"] * 16, 0.1)


def test_p_values_and_intervals_of_the_bootstrap_agree():
    law = Bootstrap.of(RNG.normal(0.0, 1.0, 12), ["a", "b", "c"] * 4)
    low, high = law.interval(0.95)
    assert law.cdf(low) == pytest.approx(0.025, abs=0.002)
    assert law.sf(high) == pytest.approx(0.025, abs=0.002)


@pytest.mark.parametrize("shift", [5.0, -5.0])
def test_a_difference_far_above_the_noise_stays_different_among_100_comparisons(shift):
    scenes = [name for name in "abcd" for _ in range(3)]
    found = estimate(shift + 0.05 * RNG.standard_normal(12), scenes, 0.1)
    assert found.method == IQM
    assert 0.0 < found.p_different < 1e-9
    assert verdicts([found] * 100) == [Verdict.DIFFERENT] * 100


def test_bootstrap_p_values_decrease_steadily_beyond_the_range_of_resamples():
    law = Bootstrap.of(RNG.normal(0.0, 1.0, 12), ["a", "b", "c"] * 4)
    borders = np.linspace(1.0, 9.0, 33)
    above = [law.sf(border) for border in borders]
    below = [law.cdf(-border) for border in borders]
    for values in (above, below):
        assert values == sorted(values, reverse=True)
        assert values[-1] < 0.1 * values[0]
        assert all(b > 0.2 * a for a, b in pairwise(values))


@pytest.mark.parametrize(("value", "expected"), [(0.0, "equivalent"), (0.5, "different")])
def test_without_noise_many_pairs_get_the_same_verdict_as_few_pairs(value, expected):
    family = [estimate([value] * pairs, ["a"] * pairs, 0.1) for pairs in (3, 12)]
    assert {str(verdict) for verdict in verdicts(family * 10)} == {expected}


def test_the_interval_contains_its_estimate_even_if_one_run_diverged():
    values = 0.05 * np.random.default_rng(3).standard_normal((40, 12))
    values[:, 0] -= 15.0
    found = [estimate(each, ["a"] * 12, 0.1) for each in values]
    assert all(each.wide[0] < each.center < each.wide[1] for each in found)


def test_differences_between_scenes_do_not_count_as_noise():
    scenes = [name for name in "abcd" for _ in range(3)]
    levels = np.repeat([0.1, 0.2, 0.3, 0.4], 3)
    values = levels + 0.01 * RNG.standard_normal(12)
    stratified, pooled = estimate(values, scenes, 0.1), estimate(values, ["a"] * 12, 0.1)
    width = stratified.wide[1] - stratified.wide[0]
    assert width < 0.3 * (pooled.wide[1] - pooled.wide[0])


def test_scenes_with_one_pair_are_resampled_together():
    values = RNG.normal(0.0, 1.0, 12)
    scenes = [f"scene {number}" for number in range(12)]
    assert estimate(values, scenes, 0.1).wide == estimate(values, ["a"] * 12, 0.1).wide


def test_the_number_of_needed_pairs_agrees_with_the_table():
    # 0.1 dB of noise per run: half-widths 0.095 at 8 pairs and 0.104 at 7.
    assert pairs_needed(0.1 * sqrt(2.0), 0.1) == 8
    assert pairs_needed(100.0, 0.1) is None


@pytest.mark.sampled(4)
@pytest.mark.parametrize("spread", [0.01, 0.05, 0.1, 0.2, 0.4])
@pytest.mark.parametrize("scenes", [1, 4, 6])
def test_more_pairs_are_needed_exactly_if_the_interval_is_too_wide(spread, scenes):
    for seed in range(20):
        values = np.random.default_rng(seed).normal(0.0, spread, 12)
        found = estimate(values, [str(number % scenes) for number in range(12)], 0.1)
        half = (found.narrow[1] - found.narrow[0]) / 2.0
        assert (found.needed > 12) == (half > 0.1)


def test_the_verdict_on_few_comparisons_follows_the_intervals():
    # The border of the 95 % interval lies between two draws here, and zero does, too.
    values = [-0.01908, -0.018, 0.13949, 0.02263, 0.13912, -0.03991, 0.1013, 0.15068]
    values += [0.2282, 0.23885, -0.02011, -0.08109, 0.15728, 0.11603]
    scenes = [f"s{number}" for number in (0, 2, 0, 0, 2, 2, 0, 1, 0, 3, 0, 0, 0, 3)]
    found = estimate(values, scenes, 0.1)
    assert 0.0 < found.wide[0] < 0.002
    assert found.p_different > 0.05
    assert verdicts([found]) == [Verdict.DIFFERENT]
    assert verdicts([found] * 6) == [Verdict.INCONCLUSIVE] * 6


def test_noise_far_above_the_margin_gives_no_number_of_needed_pairs():
    values = np.random.default_rng(0).normal(0.0, 10.0, 12)
    assert estimate(values, ["a"] * 12, 0.1).needed is None


def test_differences_between_scenes_do_not_raise_the_number_of_needed_pairs():
    scenes = [name for name in "abcd" for _ in range(3)]
    noise = 0.1 * np.tile([-1.0, 0.0, 1.0], 4)
    levels = np.repeat([-2.0, -1.0, 1.0, 2.0], 3)
    found = estimate(levels + noise, scenes, 0.1)
    assert found.method == IQM
    assert found.needed < pairs_needed(found.deviation, 0.1)
    # Student's interval is about all scenes at once.
    few = estimate((levels + noise)[:9], scenes[:9], 0.1)
    assert few.needed == pairs_needed(few.deviation, 0.1)


def test_one_pair_is_inconclusive_and_equal_runs_are_equivalent():
    single = estimate([3.0], ["a"], 0.1)
    same = estimate([0.0, 0.0, 0.0], ["a"] * 3, 0.1)
    other = estimate([0.5, 0.5], ["a"] * 2, 0.1)
    assert single.wide == (-inf, inf)
    assert isnan(single.p_different)
    assert single.needed is None
    assert verdicts([single, same, other]) == [
        Verdict.INCONCLUSIVE,
        Verdict.EQUIVALENT,
        Verdict.DIFFERENT,
    ]


def test_holms_correction_agrees_with_known_values():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    adjusted = holm([0.02, nan, 0.01])
    assert adjusted[0] == 0.02
    assert isnan(adjusted[1])
    assert adjusted[2] == 0.02


def test_more_than_five_comparisons_are_corrected():
    found = estimate([0.09, 0.11, 0.05, 0.15, 0.02], ["a"] * 5, 0.01)
    assert 0.01 < found.p_different < 0.05
    assert verdicts([found] * 5) == [Verdict.DIFFERENT] * 5
    assert verdicts([found] * 6) == [Verdict.INCONCLUSIVE] * 6


@pytest.mark.parametrize(
    ("levels", "verdict", "contradicting"),
    [
        ((0.3, 0.3, 0.3, -0.4), Verdict.DIFFERENT, ["s3"]),
        ((0.3, 0.3, 0.3, 0.02), Verdict.DIFFERENT, []),
        ((-0.3, -0.3, -0.3, 0.4), Verdict.DIFFERENT, ["s3"]),
        ((0.0, 0.0, 0.0, 0.5), Verdict.EQUIVALENT, ["s3"]),
        ((0.0, 0.0, 0.0, 0.08), Verdict.EQUIVALENT, []),
    ],
)
def test_scenes_that_contradict_a_verdict_are_reported(levels, verdict, contradicting):
    """The interquartile mean leaves out a scene whose values are far from the other scenes."""
    scenes = [f"s{number}" for number in range(4) for _ in range(3)]
    values = np.repeat(levels, 3) + np.tile([-0.02, 0.0, 0.02], 4)
    found = estimate(values, scenes, 0.1)
    assert verdicts([found]) == [verdict]
    assert [each.scene for each in opposed(found, verdict, 0.1)] == contradicting
    assert opposed(found, Verdict.INCONCLUSIVE, 0.1) == ()


def test_a_single_scene_contradicts_no_verdict():
    assert estimate([0.1, 0.2, 0.3], ["a"] * 3, 0.1).by_scene == ()


def test_runs_that_belong_to_two_arms_count_once_in_the_noise(tmp_path):
    plan = ["run,scene,configuration,seed"]
    for number, final in enumerate((20.0, 20.4, 21.0, 22.0)):
        seed, views = number % 2, 1 + number // 2
        run = RunFolder(seed=seed, final=final, views_per_step=views)
        run.write(tmp_path / "runs" / f"r{number}")
        labels = ("one", "also one") if views == 1 else ("two",)
        plan += [f"r{number},city,{label},{seed}" for label in labels]
    (tmp_path / "runs.csv").write_text("\n".join(plan) + "\n")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert len(found.arms) == 3
    spread, freedom = found.noise["city"]
    assert freedom == 2
    assert spread == pytest.approx(sqrt((0.4**2 / 2 + 1.0**2 / 2) / 2))
