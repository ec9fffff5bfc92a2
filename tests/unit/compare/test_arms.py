"""Runs become arms by what differs in their configurations, and arms get short names."""

from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare.arms import arms_of, renamed
from crossgrad_plugins.compare.settings import settings_of
from crossgrad_plugins.compare.source import read_runs

SCAFFOLD = {"backbone": {"name": "scaffold", "offsets": 10}}


def arms(folder: Path, *runs: RunFolder):
    for number, run in enumerate(runs):
        run.write(folder / f"run-{number}")
    found = read_runs([folder], skip_broken=False)
    return arms_of(found.runs, found.failed)


def names(folder, *runs):
    return [arm.name for arm in arms(folder, *runs)]


def test_seeds_scenes_and_lengths_make_no_arm(tmp_path):
    runs = [
        RunFolder(seed=0),
        RunFolder(seed=1, steps=300),
        RunFolder(scene="park", planned=70.0, steps=431),
        RunFolder(seed=2, settings={"eval_every": 10, "threads": 2, "save_every": 9}),
    ]
    [only] = arms(tmp_path, *runs)
    assert len(only.runs) == len(runs)


def test_an_arm_is_named_by_what_tells_it_apart(tmp_path):
    found = names(tmp_path, RunFolder(views_per_step=2), RunFolder(), RunFolder(views_per_step=10))
    assert found == ["views=1", "views=2", "views=10"]


def test_what_a_component_brings_is_not_in_the_name(tmp_path):
    [scaffold, vanilla] = arms(
        tmp_path,
        RunFolder(settings={**SCAFFOLD, "densifier": {"name": "anchor", "levels": 3}}),
        RunFolder(settings={"densifier": {"name": "adc"}}),
    )
    assert [scaffold.name, vanilla.name] == ["backbone=scaffold", "backbone=vanilla"]
    assert scaffold.settings == {"backbone": "scaffold", "densifier": "anchor"}


def test_two_things_that_differ_are_both_named(tmp_path):
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


def test_options_of_one_component_are_told_apart_beside_another_one(tmp_path):
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


def test_what_follows_from_the_scene_makes_no_arm(tmp_path):
    low, high = ({"backbone": {"name": "vanilla", "sh_degree": n}} for n in (1, 3))
    runs = [
        RunFolder(scene=scene, settings=settings, views_per_step=views)
        for scene, settings in (("city", low), ("park", high))
        for views in (1, 2)
    ]
    assert names(tmp_path, *runs) == ["views=1", "views=2"]


def test_an_option_that_an_older_version_lacks_makes_no_arm(tmp_path):
    old = {"backbone": {"name": "vanilla"}}
    new = {"backbone": {"name": "vanilla", "sh_degree": 3}}
    assert len(names(tmp_path, RunFolder(settings=old), RunFolder(seed=1, settings=new))) == 1


def test_labels_of_a_sweep_are_taken_and_a_run_can_have_two(tmp_path):
    RunFolder(seed=0).write(tmp_path / "runs" / "aa")
    RunFolder(seed=0, steps=900).write(tmp_path / "runs" / "bb")
    plan = "run,scene,configuration,seed\naa,city,views,0\nbb,city,seconds,0\nbb,city,steps,0\n"
    (tmp_path / "runs.csv").write_text(plan)
    found = read_runs([tmp_path], skip_broken=False)
    assert [arm.name for arm in arms_of(found.runs)] == ["seconds", "steps", "views"]


def test_lengths_in_a_label_make_no_arm(tmp_path):
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


def test_settings_are_flat_texts():
    config = {
        "scene": "x",
        "seed": 3,
        "backbone": {"name": "vanilla", "lr": 0.0016, "on": True},
        "operator": [{"name": "a"}, {"name": "b", "c": 0.5}],
        "grouping": None,
        "reading": {"max_size": 400, "cache_mib": 2048},
        "background": "black",
    }
    assert settings_of(config) == {
        "backbone": "vanilla",
        "backbone.lr": "0.0016",
        "backbone.on": "yes",
        "operator": "a+b",
        "operator.1.c": "0.5",
        "reading.max_size": "400",
        "background": "black",
    }
