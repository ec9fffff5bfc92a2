"""From a grid to runs: ids, and what is refused before anything is started."""

import shutil

import pytest
import yaml
from support.scenes import write_tiny_scene

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.grid import read_grid
from crossgrad_plugins.sweep.job import run_id
from crossgrad_plugins.sweep.plan import planned


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "tiny"
    write_tiny_scene(folder, views=4)
    return folder


def plan(folder, assignments=(), **grid):
    path = folder / "grid.yaml"
    path.write_text(yaml.safe_dump(grid))
    return planned(read_grid(path), path, assignments)


def test_the_id_of_a_run_does_not_depend_on_notes_about_its_length():
    plain = {"seed": 1, "steps": 9}
    noted = {**plain, "revisions": [[1, 9]], "planned_seconds": 5.0, "planned_views": 9}
    assert run_id(noted, "scene") == run_id(plain, "scene")


def ids(folder, scene, **base):
    return [job.id for job in plan(folder, scenes=[str(scene)], base=base).jobs]


def test_seeds_vary_slowest_in_the_order_of_runs(scene, tmp_path):
    found = plan(
        tmp_path, scenes=[str(scene)], seeds=[5, 6], parameters={"views": {"values": [1, 2]}}
    )
    assert [(job.seed, job.label) for job in found.jobs] == [
        (seed, f"run, views={views}") for seed in (5, 6) for views in (1, 2)
    ]
    assert len({job.id for job in found.jobs}) == 4


def test_the_id_of_a_run_depends_only_on_its_training(scene, tmp_path):
    (one,) = ids(tmp_path, scene, steps=30)
    elsewhere = tmp_path / "moved" / "under-another-name"
    shutil.copytree(scene, elsewhere)
    same = [
        ids(tmp_path, elsewhere, steps=30),
        ids(tmp_path, scene, steps=30, save_every=7),
        ids(tmp_path, scene, steps=30, operator="sum"),
        ids(tmp_path, scene, steps=30, sampler={"name": "epoch"}, views_per_step=1),
        ids(tmp_path, scene, **{"steps": 30, "backbone.lr_opacities": 0.05}),
    ]
    assert same == [[one]] * len(same)
    others = [
        ids(tmp_path, scene, steps=31),
        ids(tmp_path, scene, steps=30, views=2),
        ids(tmp_path, scene, seconds=4),
        ids(tmp_path, scene, steps=30, max_size=32),
        ids(tmp_path, scene, **{"steps": 30, "backbone.lr_opacities": 0.06}),
    ]
    photo = next((elsewhere / "images").iterdir())
    photo.write_bytes(photo.read_bytes() + b"\0")
    others.append(ids(tmp_path, elsewhere, steps=30))
    assert len({one, *(each for (each,) in others)}) == len(others) + 1


def test_two_configurations_with_equal_settings_share_one_run(scene, tmp_path):
    arms = [{"name": "a"}, {"name": "b", "settings": {"operator": "sum"}}]
    found = plan(tmp_path, scenes=[str(scene)], arms=arms)
    assert [cell.label for cell in found.cells] == ["a", "b"]
    assert len(found.jobs) == 1


def test_an_arm_with_another_component_drops_the_options_of_the_base(scene, tmp_path):
    base = {"operator": {"name": "cagrad", "c": 0.3}, "data": {"max_size": 40}, "steps": 9}
    arms = [
        {"name": "a", "settings": {"operator.c": 0.1, "data": {"test_every": 4}}},
        {"name": "b", "settings": {"operator": "sum", "seconds": 5}},
    ]
    one, other = plan(tmp_path, scenes=[str(scene)], base=base, arms=arms).jobs
    assert one.settings["operator"] == {"name": "cagrad", "c": 0.1}
    assert one.settings["data"] == {"max_size": 40, "test_every": 4}
    assert other.settings["operator"] == {"name": "sum"}
    assert (other.settings["seconds"], other.seconds) == (5, 5.0)
    assert "steps" not in other.settings


def test_settings_of_scenes_and_of_the_command_line_override_the_base(scene, tmp_path):
    arms = [{"name": "a", "by_scene": {"tiny": {"views": 3, "steps": 4}}}]
    grid = {"scenes": [str(scene)], "arms": arms, "base": {"views": 1}}
    (job,) = plan(tmp_path, ["steps=6"], **grid).jobs
    assert (job.settings["views_per_step"], job.settings["steps"]) == (3, 6)


def test_all_errors_are_reported_at_once(scene, tmp_path):
    arms = [
        {"name": "unknown", "settings": {"opertor": "sum"}},
        {"name": "name", "settings": {"sampler": "epoc"}},
        {"name": "option", "settings": {"operator": {"name": "cagrad", "c": -1, "d": 2}}},
        {"name": "pair", "settings": {"sampler": "near-far", "views": 3}},
        {"name": "two", "settings": {"sampler": "epoc", "backbone": "vanila"}},
        {"name": "nothing", "settings": {"densifier": "none", "densify_every": 5}},
        {"name": "many", "settings": {"views": 99}},
        {"name": "good"},
    ]
    scenes = [str(scene), str(tmp_path / "nowhere")]
    with pytest.raises(UserError) as caught:
        plan(tmp_path, scenes=scenes, arms=arms, seeds=[1, 2, 3])
    text = str(caught.value)
    assert "opertor" in text and "'epoc'" in text and "cagrad" in text and "'vanila'" in text
    assert "tiny, pair: " in text and "tiny, nothing: " in text and "nowhere" in text
    assert "name; two: there is no sampler" in text
    assert "the grid has 8 errors" in text and "99 different views" in text


def test_an_error_of_all_configurations_is_reported_once(scene, tmp_path):
    with pytest.raises(UserError, match="has an error") as caught:
        plan(
            tmp_path,
            scenes=[str(scene)],
            base={"steps": -1},
            parameters={"views": {"values": [1, 2, 3, 4, 5]}},
        )
    assert "and 2 more: option steps" in str(caught.value)
