"""Runs become arms by what differs in their configurations, and arms get short names."""

from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare.arms import arms_of, renamed
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.run import settings_of

SCAFFOLD = {"backbone": {"name": "scaffold", "offsets": 10}}


def arms(folder: Path, *runs: RunFolder):
    for number, run in enumerate(runs):
        run.write(folder / f"run-{number}")
    found = read_runs([folder], skip_broken=False)
    return arms_of(found.runs, found.failed)


def names(folder, *runs):
    return [arm.name for arm in arms(folder, *runs)]


def test_seeds_scenes_and_lengths_do_not_distinguish_arms(tmp_path):
    runs = [
        RunFolder(seed=0),
        RunFolder(seed=1, steps=300),
        RunFolder(scene="park", planned=70.0, steps=431),
        RunFolder(scene="park", seed=1, settings={"planned_seconds": 80.0}, steps=523),
        RunFolder(seed=2, settings={"eval_every": 10, "threads": 2, "save_every": 9}),
    ]
    [only] = arms(tmp_path, *runs)
    assert len(only.runs) == len(runs)


def test_an_arm_is_named_by_the_setting_that_differs(tmp_path):
    found = names(tmp_path, RunFolder(views_per_step=2), RunFolder(), RunFolder(views_per_step=10))
    assert found == ["views=1", "views=2", "views=10"]


def test_an_arm_name_omits_defaults_that_follow_from_a_component(tmp_path):
    [scaffold, vanilla] = arms(
        tmp_path,
        RunFolder(settings={**SCAFFOLD, "densifier": {"name": "anchor", "levels": 3}}),
        RunFolder(settings={"densifier": {"name": "adc"}}),
    )
    assert [scaffold.name, vanilla.name] == ["backbone=scaffold", "backbone=vanilla"]
    assert scaffold.settings == {"backbone": "scaffold", "densifier": "anchor"}


def test_an_arm_name_contains_both_settings_that_differ(tmp_path):
    found = names(
        tmp_path,
        RunFolder(views_per_step=2),
        RunFolder(views_per_step=1),
        RunFolder(views_per_step=2, settings={"operator": [{"name": "pcgrad"}, {"name": "soft"}]}),
    )
    assert found == [
        "views=1, operator=sum",
        "views=2, operator=pcgrad+soft",
        "views=2, operator=sum",
    ]


def test_options_distinguish_two_arms_of_one_component_if_a_third_uses_another_component(tmp_path):
    found = names(
        tmp_path,
        RunFolder(settings={"operator": {"name": "cagrad", "c": 0.4}}),
        RunFolder(settings={"operator": {"name": "cagrad", "c": 0.8}}),
        RunFolder(settings={"operator": {"name": "sum"}}),
    )
    assert found == [
        "operator=cagrad, operator.c=0.4",
        "operator=cagrad, operator.c=0.8",
        "operator=sum",
    ]


def test_settings_that_follow_from_the_scene_do_not_distinguish_arms(tmp_path):
    low, high = ({"backbone": {"name": "vanilla", "sh_degree": n}} for n in (1, 3))
    runs = [
        RunFolder(scene=scene, settings=settings, views_per_step=views)
        for scene, settings in (("city", low), ("park", high))
        for views in (1, 2)
    ]
    assert names(tmp_path, *runs) == ["views=1", "views=2"]


def test_an_option_missing_in_an_older_version_does_not_distinguish_arms(tmp_path):
    old = {"backbone": {"name": "vanilla"}}
    new = {"backbone": {"name": "vanilla", "sh_degree": 3}}
    assert len(names(tmp_path, RunFolder(settings=old), RunFolder(seed=1, settings=new))) == 1


def test_a_setting_given_in_one_arm_only_distinguishes_the_arms(tmp_path):
    few, mip = {"max_gaussians": 5000}, {"backbone": {"name": "mip"}}
    runs = [RunFolder(seed=n, settings=own) for own in ({}, few, mip) for n in range(3)]
    found = arms(tmp_path, *runs)
    assert [arm.name for arm in found] == [
        "backbone=mip",
        "backbone=vanilla",
        "backbone=vanilla, max_gaussians=5000",
    ]
    assert [len(arm.runs) for arm in found] == [3, 3, 3]
    assert found[1].settings["max_gaussians"] == "-"
    assert names(tmp_path / "two", *(RunFolder(settings=own) for own in ({}, few))) == [
        "max_gaussians=5000",
        "max_gaussians=none",
    ]


def test_an_option_that_is_none_in_one_arm_distinguishes_the_arms(tmp_path):
    runs = [RunFolder(settings={"loss": {"name": "dssim", "clip": c}}) for c in (None, 0.5)]
    assert names(tmp_path, *runs) == ["loss.clip=0.5", "loss.clip=none"]


def test_a_setting_missing_in_a_file_equals_a_setting_that_is_none(tmp_path):
    few = {"max_gaussians": 5000}
    runs = RunFolder(), RunFolder(seed=1), RunFolder(settings=few), RunFolder(seed=1, settings=few)
    for number, run in enumerate(runs):
        run.write(tmp_path / str(number))
    config = tmp_path / "0" / "config.yaml"
    config.write_text(config.read_text().replace("max_gaussians: null\n", ""))
    found = read_runs([tmp_path], skip_broken=False)
    assert [len(arm.runs) for arm in arms_of(found.runs)] == [2, 2]


def sweep(folder: Path, runs: dict[str, RunFolder]):
    """Runs by their labels, in a folder as a sweep leaves it."""
    lines = []
    for number, (label, run) in enumerate(runs.items()):
        run.write(folder / "runs" / str(number))
        lines.append(f'{number},"{label}"')
    (folder / "runs.csv").write_text("\n".join(["run,configuration", *lines]) + "\n")


def swept(folder: Path):
    found = read_runs([folder], skip_broken=False)
    return {arm.name: len(arm.runs) for arm in arms_of(found.runs, found.failed)}


def test_equal_labels_of_two_sweeps_are_distinguished_by_settings(tmp_path):
    sweep(tmp_path / "a", {"run": RunFolder()})
    sweep(tmp_path / "b", {"run": RunFolder(settings={"backbone": {"name": "mip"}})})
    assert swept(tmp_path) == {"backbone=mip": 1, "backbone=vanilla": 1}


def test_a_label_with_one_configuration_per_scene_names_the_arm(tmp_path):
    for folder, factor in (("a", 1.0), ("b", 2.0)):
        runs = {
            "one": RunFolder(),
            "two": RunFolder(views_per_step=2, settings={"rate_factor": factor}),
        }
        sweep(tmp_path / folder, runs)
    tuned = RunFolder(scene="park", settings={"rate_factor": 0.5})
    sweep(tmp_path / "c", {"one": tuned})
    assert swept(tmp_path) == {"one": 3, "two, rate_factor=1": 1, "two, rate_factor=2": 1}


def test_arm_names_are_unique(tmp_path):
    sweep(tmp_path / "a", {"x": RunFolder(), "x, views=2": RunFolder(steps=9, views_per_step=4)})
    sweep(tmp_path / "b", {"x": RunFolder(views_per_step=2)})
    assert swept(tmp_path) == {"views=1": 1, "views=2": 1, "views=4": 1}


def test_a_run_with_two_labels_counts_once_next_to_a_run_without_label(tmp_path):
    RunFolder().write(tmp_path / "runs" / "aa")
    (tmp_path / "runs.csv").write_text("run,configuration\naa,one\naa,two\n")
    RunFolder(views_per_step=2).write(tmp_path / "other")
    assert swept(tmp_path) == {"views=1": 1, "views=2": 1}


def test_sweep_labels_become_arm_names_and_a_run_can_have_two(tmp_path):
    RunFolder(seed=0).write(tmp_path / "runs" / "aa")
    RunFolder(seed=0, steps=900).write(tmp_path / "runs" / "bb")
    plan = "run,scene,configuration,seed\naa,city,views,0\nbb,city,seconds,0\nbb,city,steps,0\n"
    (tmp_path / "runs.csv").write_text(plan)
    found = read_runs([tmp_path], skip_broken=False)
    assert [arm.name for arm in arms_of(found.runs)] == ["seconds", "steps", "views"]


def test_lengths_in_a_label_do_not_distinguish_arms(tmp_path):
    for number in range(4):
        RunFolder(steps=100 + 100 * number).write(tmp_path / "runs" / str(number))
    labels = ('"run, steps=100"', '"run, steps=200"', '"two, views=2, seconds=9"', "run")
    lines = [f"{number},{label}" for number, label in enumerate(labels)]
    (tmp_path / "runs.csv").write_text("\n".join(["run,configuration", *lines]) + "\n")
    found = read_runs([tmp_path], skip_broken=False)
    assert [arm.name for arm in arms_of(found.runs)] == ["run", "two, views=2"]


def test_arms_can_be_renamed(tmp_path):
    found = arms(tmp_path, RunFolder(views_per_step=2), RunFolder())
    assert [arm.name for arm in renamed(found, ["views=2:two: both"])] == ["views=1", "two: both"]
    for wrong in ("views=3:x", "views=1:", "views=1:views=2"):
        with pytest.raises(UserError, match="name"):
            renamed(found, [wrong])


def test_runs_with_a_planned_number_of_views_form_another_arm():
    whole = settings_of({"planned_seconds": 60.0, "planned_views": None})
    assert settings_of({"planned_seconds": 60.0, "planned_views": 500}) != whole
    assert settings_of({"planned_seconds": 90.0, "planned_views": None}) == whole


def test_settings_are_flattened_to_texts():
    config = {
        "scene": "x",
        "seed": 3,
        "backbone": {"name": "vanilla", "lr": 0.0016, "on": True},
        "operator": [{"name": "a"}, {"name": "b", "c": 0.5}],
        "grouping": None,
        "data": {"max_size": 400, "cache_mib": 2048},
        "background": "black",
    }
    assert settings_of(config) == {
        "backbone": "vanilla",
        "backbone.lr": "0.0016",
        "backbone.on": "yes",
        "operator": "a+b",
        "operator.1.c": "0.5",
        "grouping": "-",
        "data.max_size": "400",
        "background": "black",
    }


def test_arm_names_may_contain_colons_and_unicode_digits(tmp_path):
    plan = ["run,scene,configuration,seed"]
    for number, name in enumerate(("rate 10\u2074", "two", "two: x")):
        RunFolder(views_per_step=1 + number).write(tmp_path / "runs" / f"r{number}")
        plan.append(f"r{number},city,{name},0")
    (tmp_path / "runs.csv").write_text("\n".join(plan) + "\n")
    arms = arms_of(read_runs([tmp_path], skip_broken=False).runs)
    assert [arm.name for arm in arms] == ["rate 10\u2074", "two", "two: x"]
    names = [arm.name for arm in renamed(arms, ["two: x:new"])]
    assert names == ["rate 10\u2074", "two", "new"]
