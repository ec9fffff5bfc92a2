"""Values at equal cost, costs to a quality, profiles, lengths."""

import json
from math import inf, isclose, nan
from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_plugins.compare.arms import Cells, arms_of
from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.quantity import SECONDS, STEPS, VIEWS, Quantity
from crossgrad_plugins.compare.tables import csv_tables
from crossgrad_plugins.compare.targets import cost_to, ratios, targets_of, value_at


def comparison(folder: Path, *runs: RunFolder, **options):
    for number, run in enumerate(runs):
        run.write(folder / f"run-{number}")
    return compared(read_runs([folder], skip_broken=False), Options(**options))


def test_a_curve_is_interpolated_only_between_its_evaluations(tmp_path):
    model = RunFolder(steps=600, seconds=60.0, evaluations=6)
    found = comparison(tmp_path, model)
    run, quantity = found.runs[0], found.quantity
    middle = (model.psnr(1 / 6) + model.psnr(2 / 6)) / 2
    assert value_at(run, quantity, STEPS, 150) == pytest.approx(middle)
    assert value_at(run, quantity, SECONDS, 60.0) == pytest.approx(21.0)
    assert value_at(run, quantity, STEPS, 99) is None
    assert value_at(run, quantity, STEPS, 610) == pytest.approx(21.0)
    assert value_at(run, quantity, STEPS, 700) is None


def test_the_cost_of_reaching_a_quality_is_interpolated_or_infinite(tmp_path):
    model = RunFolder(steps=600, seconds=60.0, evaluations=6)
    found = comparison(tmp_path, model)
    run, quantity = found.runs[0], found.quantity
    middle = (model.psnr(1 / 6) + model.psnr(2 / 6)) / 2
    assert cost_to(run, quantity, SECONDS, middle) == pytest.approx(15.0)
    assert cost_to(run, quantity, STEPS, 0.0) == 100.0
    assert cost_to(run, quantity, STEPS, 21.1) == inf


def test_quality_at_equal_cost_is_measured_at_the_end_of_the_shorter_run(tmp_path):
    one = RunFolder(views_per_step=1, steps=1200, final=21.0)
    two = RunFolder(views_per_step=2, steps=600, final=21.5)
    found = comparison(tmp_path, one, two)
    assert found.amounts == {("seconds", "city"): 60.0, ("views", "city"): 1200.0,
                             ("steps", "city"): 600.0}  # fmt: skip
    # Seconds and views are equal at the ends, steps are not: only they need a reading of their own.
    assert [each.where for each in found.equal] == ["steps"]
    [steps] = found.equal
    assert steps.inside
    assert steps.pairs[0].first == pytest.approx(21.5)
    assert steps.pairs[0].second == pytest.approx(one.psnr(0.5))


def test_a_run_that_never_reaches_the_target_still_counts_in_the_profile(tmp_path):
    runs = [RunFolder(seed=0), RunFolder(seed=1, final=20.0)]
    runs += [RunFolder(seed=n, views_per_step=2, steps=300, seconds=30.0) for n in range(3)]
    runs += [RunFolder(seed=2, status="failed")]
    found = comparison(tmp_path, *runs, target=20.9)
    rows = {(row.arm, row.cost.name): row for row in found.reached}
    assert rows["views=1", "seconds"].amounts[1] == inf
    assert rows["views=1", "seconds"].amounts[2] == inf
    assert (rows["views=1", "seconds"].reached, rows["views=2", "seconds"].reached) == (1, 3)
    assert rows["views=1", "seconds"].median == inf
    by_arm = ratios([row for row in found.reached if row.cost == SECONDS])
    assert len(by_arm["views=1"]) == 3
    assert min(by_arm["views=1"]) == pytest.approx(2.0)
    assert by_arm["views=1"].count(inf) == 2
    assert all(ratio == 1.0 for ratio in by_arm["views=2"])


def test_the_default_target_is_the_final_quality_of_the_weakest_arm(tmp_path):
    runs = [RunFolder(seed=n, final=20.0 + n) for n in range(3)]
    runs += [RunFolder(seed=n, views_per_step=2, final=23.0 + n) for n in range(3)]
    found = comparison(tmp_path, *runs)
    assert {row.target for row in found.reached} == {21.0}


def test_runs_of_several_lengths_are_paired_by_length(tmp_path):
    runs = [
        RunFolder(seed=seed, views_per_step=views, steps=steps, final=20.0 + steps / 1000 + views)
        for seed in range(2)
        for views in (1, 2)
        for steps in (300, 600)
    ]
    found = comparison(tmp_path, *runs)
    assert {run.length_text for run in found.runs} == {"600 steps"}
    [end] = found.ends
    assert len(end.pairs) == 2
    assert end.estimate.center == pytest.approx(1.0)
    assert [(gain.where, gain.first, gain.second) for gain in found.gains] == [
        ("views=1", "600 steps", "300 steps"),
        ("views=2", "600 steps", "300 steps"),
    ]
    assert all(gain.estimate.center == pytest.approx(0.3) for gain in found.gains)
    assert len(found.points) == 4


def test_a_time_budget_counts_as_the_length_for_any_number_of_steps(tmp_path):
    runs = [
        RunFolder(seed=n, planned=70.0, steps=400 + 7 * n, views_per_step=k)
        for n in range(2)
        for k in (1, 2)
    ]
    found = comparison(tmp_path, *runs)
    assert {run.length_text for run in found.runs} == {"70 s"}
    assert not found.cells.several
    assert len(found.ends[0].pairs) == 2


@pytest.mark.parametrize(("metric", "sign"), [("psnr", 1.0), ("lpips", -1.0)])
def test_at_least_half_of_the_runs_of_the_weakest_arm_reach_the_default_target(
    tmp_path, metric, sign
):
    ends = {1: (20.0, 20.4, 20.6, 22.0), 2: (23.0, 24.0, 25.0, 26.0)}
    for views, finals in ends.items():
        for seed, final in enumerate(finals):
            folder = RunFolder(seed=seed, views_per_step=views).write(tmp_path / f"{views}-{seed}")
            path = folder / "summary.json"
            summary = json.loads(path.read_text())
            summary["overall"] |= {"psnr": final, "lpips": 1.0 - final / 100.0}
            path.write_text(json.dumps(summary))
    found = read_runs([tmp_path], skip_broken=False)
    main = Cells.of(arms_of(found.runs)).main()
    [goal] = targets_of(main, Quantity.of(metric), None).values()
    assert goal == pytest.approx({"psnr": 20.4, "lpips": 1.0 - 0.204}[metric])
    finals = [run.final(metric) for run in main["views=1"].values()]
    assert sum(sign * final >= sign * goal for final in finals) == 3


def test_both_runs_of_the_weakest_arm_reach_its_lower_final_quality(tmp_path):
    runs = [RunFolder(seed=n, final=20.0 + n) for n in range(2)]
    runs += [RunFolder(seed=n, views_per_step=2, final=23.0 + n) for n in range(2)]
    found = comparison(tmp_path, *runs)
    assert {row.target for row in found.reached} == {20.0}
    assert all(row.median < inf for row in found.reached)


def test_each_table_is_written_to_its_own_file(tmp_path):
    finals = {1: (20.0, 20.1, 20.3), 2: (20.4, 20.3, 20.9)}
    regimes = dict.fromkeys("abcdef", 0.0)
    for views, own in finals.items():
        for seed, final in enumerate(own):
            run = RunFolder(seed=seed, views_per_step=views, final=final, regimes=regimes)
            run.write(tmp_path / f"{views}-{seed}")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert [each.where for each in found.ends] == ["at the end"]
    assert [each.where for each in found.regimes] == ["overall", *"abcdef"]
    rows = csv_tables(found, {})["comparisons.csv"]
    kinds = [(row["figure"], row["where"], row["first"], row["second"]) for row in rows]
    assert len(set(kinds)) == len(kinds)


def arms_with(folder, *runs):
    """Scene, seed and steps of each arm's main runs; runs are factor, seed, steps and scene."""
    folders = [
        RunFolder(*rest, seed=seed, steps=steps, settings={"rate_factor": factor})
        for factor, seed, steps, *rest in runs
    ]
    found = comparison(folder, *folders)
    return found, {
        arm: sorted((scene, seed, int(run.length[1])) for (scene, seed), run in by.items())
        for arm, by in found.main.items()
    }


def test_a_short_run_does_not_replace_a_missing_long_run(tmp_path):
    long = [(factor, seed, 600) for factor in (1.0, 2.0) for seed in range(3)]
    runs = [run for run in long if run != (1.0, 2, 600)]
    found, main = arms_with(tmp_path, *runs, (1.0, 2, 300), (1.0, 0, 300))
    assert main["rate_factor=1"] == [("city", 0, 600), ("city", 1, 600)]
    assert [pair.seed for pair in found.ends[0].pairs] == [0, 1]
    assert found.left_out == {
        "run-5": "has 300 steps, but other runs of rate_factor=1 on city have 600 steps"
    }
    # Its length is still a point of the frontier.
    assert {(point.length, point.seeds) for point in found.points} == {
        ("300 steps", 2),
        ("600 steps", 2),
        ("600 steps", 3),
    }


def test_each_scene_has_its_own_default_length(tmp_path):
    runs = [(factor, seed, 600) for factor in (1.0, 2.0) for seed in range(2)]
    runs += [(factor, 0, 300, "park") for factor in (1.0, 2.0)] + [(1.0, 1, 600, "park")]
    found, main = arms_with(tmp_path, *runs)
    assert main["rate_factor=1"] == [("city", 0, 600), ("city", 1, 600), ("park", 0, 300)]
    assert main["rate_factor=2"] == main["rate_factor=1"]
    assert len(found.ends[0].pairs) == 3


def test_an_arm_keeps_its_length_even_if_one_run_has_the_length_of_another_arm(tmp_path):
    # Two views in half the steps; and one run of one view that is as short.
    runs = [RunFolder(seed=n, steps=1200) for n in range(3)]
    runs += [RunFolder(seed=n, steps=600, views_per_step=2) for n in range(3)]
    found = comparison(tmp_path, *runs, RunFolder(steps=600))
    lengths = {arm: {run.length_text for run in by.values()} for arm, by in found.main.items()}
    assert lengths == {"views=1": {"1,200 steps"}, "views=2": {"600 steps"}}
    assert len(found.ends[0].pairs) == 3


@pytest.mark.parametrize(("clock", "text"), [("wall", "70 s"), ("cpu", "70 s CPU")])
def test_planned_seconds_are_shown_as_the_length_of_a_run(tmp_path, clock, text):
    settings = {"planned_seconds": 70.0, "clock": clock, "revisions": [[9, 4312]]}
    found = comparison(tmp_path, RunFolder(settings=settings, steps=4312))
    assert [run.length_text for run in found.runs] == [text]


def test_an_arm_gains_nothing_by_leaving_out_a_hard_scene(tmp_path):
    runs = [RunFolder(scene=s, final=f) for s, f in (("easy", 30.0), ("hard", 15.0))]
    runs += [RunFolder(scene="easy", final=29.0, views_per_step=2)]
    assert comparison(tmp_path, *runs).ranking == ("views=1", "views=2")


def test_the_noise_of_a_scene_is_pooled_over_arms(tmp_path):
    finals = {1: (20.0, 20.2), 2: (22.0, 22.4), 3: (25.0,)}
    runs = [
        RunFolder(seed=seed, views_per_step=views, final=final)
        for views, own in finals.items()
        for seed, final in enumerate(own)
    ]
    found = comparison(tmp_path, *runs, RunFolder(scene="park"))
    (deviation, freedom) = found.noise["city"]
    assert freedom == 2
    assert isclose(deviation, ((0.1**2 * 2 + 0.2**2 * 2) / 2) ** 0.5)
    assert "park" not in found.noise


def test_a_run_without_a_finite_final_metric_is_named_and_not_paired(tmp_path):
    runs = [RunFolder(seed=n, views_per_step=k) for n in range(2) for k in (1, 2)]
    found = comparison(
        tmp_path, *runs, RunFolder(seed=2), RunFolder(seed=2, views_per_step=2, final=nan)
    )
    assert len(found.ends[0].pairs) == 2
    assert any("run-5 has no PSNR at its end" in note for note in found.notes)
    assert {row.amounts[2] for row in found.reached if row.arm == "views=2"} == {inf}


def test_cost_in_views_is_steps_times_views_per_step(tmp_path):
    found = comparison(tmp_path, RunFolder(views_per_step=3, steps=100))
    assert found.runs[0].spent(VIEWS) == 300.0
    assert VIEWS.shown(1234.0) == "1,234 views"
    assert SECONDS.shown(1.234) == "1.23 s"
