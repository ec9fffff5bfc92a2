"""The grid with the best parameters of each arm and scene."""

import pytest
import yaml
from support.scenes import write_tiny_scene

from crossgrad_core.commands import UserError, write_mapping
from crossgrad_plugins.sweep.app import Request, Sweep
from crossgrad_plugins.sweep.best import best_grid
from crossgrad_plugins.sweep.grid import choices, read_grid, scene_name
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.run_status import Standing

GRID = """
name: tuning
base: {steps: 9}
scenes: [town, beach]
seeds: [4, 2]
parameters: {rate_factor: {values: [0.5, 1, 2]}}
arms:
  - {name: one, settings: {views: 1}}
  - {name: two, settings: {views: 2}, by_scene: {beach: {steps: 5}}}
"""
#: Figure by arm, scene and factor, the mean of two seeds that are 2 apart.
BEST = {
    ("one", "town"): 1,
    ("one", "beach"): 2,
    ("two", "town"): 0.5,
    ("two", "beach"): 1,
}


@pytest.fixture
def swept(tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(GRID)
    grid = read_grid(path)
    cells, standings = [], []
    for seed in grid.seeds:
        for scene in map(scene_name, grid.scenes):
            for choice in choices(grid):
                job = Job(f"{len(cells)}", choice.label, scene, seed, {})
                off = abs(BEST[choice.arm.name, scene] - choice.parameters["rate_factor"])
                summary = {"overall": {"psnr": 20.0 - off + seed}}
                cells.append(job)
                standings.append(Standing(job, "finished", summary=summary))
    return grid, cells, standings


def test_the_best_grid_contains_each_arm_as_given_and_at_its_best_value(swept, tmp_path):
    content, notes = best_grid(*swept, tmp_path / "elsewhere")
    path = tmp_path / "elsewhere" / "best.yaml"
    path.parent.mkdir()
    write_mapping(path, content)
    found = read_grid(path)
    assert found.name == "tuning-best"
    assert found.seeds == (5, 6, 7)
    assert [scene_name(each) for each in found.scenes] == ["town", "beach"]
    assert found.scenes == swept[0].scenes
    assert [arm.name for arm in found.arms] == ["one", "one, best", "two", "two, best"]
    assert found.arms[0].by_scene == {}
    assert found.arms[1].by_scene == {"town": {"rate_factor": 1}, "beach": {"rate_factor": 2}}
    assert found.arms[3].by_scene == {
        "town": {"rate_factor": 0.5},
        "beach": {"rate_factor": 1, "steps": 5},
    }
    assert yaml.safe_load(path.read_text())["base"] == {"steps": 9}
    assert notes == [
        "beach, one: the best rate_factor is 2, the smallest or largest of its values",
        "town, two: the best rate_factor is 0.5, the smallest or largest of its values",
    ]


def test_a_grid_without_a_name_gives_a_best_grid_without_a_name(swept, tmp_path):
    grid, cells, standings = swept
    nameless = grid.model_copy(update={"name": None})
    assert "name" not in best_grid(nameless, cells, standings, tmp_path)[0]


def test_a_metric_to_minimize_selects_the_parameter_value_with_the_smallest_result(swept, tmp_path):
    grid, cells, standings = swept
    metric = grid.metric.model_copy(update={"goal": "minimize"})
    content, _ = best_grid(grid.model_copy(update={"metric": metric}), cells, standings, tmp_path)
    assert content["arms"][1]["by_scene"]["beach"] == {"rate_factor": 0.5}


def with_ends(swept, ends):
    """The grid swept, with other ends: (configuration, scene, seed) -> state, or figure."""
    grid, cells, standings = swept
    found = []
    for each in standings:
        key = (each.job.label, each.job.scene, each.job.seed)
        end = ends.get(key)
        if isinstance(end, str):
            found.append(Standing(each.job, end))
        elif key in ends:
            found.append(Standing(each.job, "finished", summary={"overall": {"psnr": end}}))
        else:
            found.append(each)
    return grid, cells, found


def test_parameter_values_are_compared_on_the_same_seeds(swept, tmp_path):
    # Seed 4 has higher figures: a mean over it alone would win.
    left = with_ends(swept, {("one, rate_factor=0.5", "town", 2): "interrupted"})
    with pytest.raises(UserError, match="2 of 3 values finished"):
        best_grid(*left, tmp_path)
    for end in ("failed", None, float("nan")):
        gone = with_ends(swept, {("one, rate_factor=0.5", "town", 2): end})
        content, notes = best_grid(*gone, tmp_path)
        assert content["arms"][1]["by_scene"]["town"] == {"rate_factor": 1}
        assert notes[0].startswith("town, one, rate_factor=0.5: not a candidate")
        assert notes[0].endswith("with seed 2")


def test_choosing_the_best_value_fails_if_all_runs_failed(swept, tmp_path):
    labels = [f"two, rate_factor={factor}" for factor in (0.5, 1, 2)]
    gone = with_ends(swept, {(label, "beach", 4): "failed" for label in labels})
    with pytest.raises(UserError, match="best parameters cannot be chosen") as error:
        best_grid(*gone, tmp_path)
    assert error.value.where == "beach, arm two"


def test_an_existing_best_grid_file_is_not_overwritten(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=9)
    path, best = tmp_path / "grid.yaml", tmp_path / "best.yaml"
    path.write_text(f"scenes: [{scene}]\nbase: {{steps: 9}}\n")
    best.write_text("mine")
    with pytest.raises(UserError, match="the output file already exists"):
        Sweep(Request(path, out=tmp_path / "out"), read_only=True).write_best(best)
    assert best.read_text() == "mine"


def test_the_best_grid_is_refused_before_all_runs_are_finished(swept, tmp_path):
    grid, cells, standings = swept
    left = [
        Standing(each.job, "waiting") if each.job.scene == "beach" else each for each in standings
    ]
    with pytest.raises(UserError, match="0 of 3 values finished"):
        best_grid(grid, cells, left, tmp_path)


CHOICES = """
- {name: a, settings: {operator: cagrad}, parameters: {operator.c: {values: [0.2, 0.4]}}}
---
- {name: a, parameters: {backbone.lr_opacities: {values: [0.02, 0.04]}}}
---
- {name: a, parameters: {operator: {values: [sum, cagrad]}}, by_scene: {town: {operator: sum}}}
---
- name: a
  parameters: {operator.c: {values: [0.2, 0.4]}, operator.name: {value: cagrad}}
  by_scene: {town: {operator: sum}}
---
- {name: a, parameters: {steps: {values: [10, 20]}}, by_scene: {town: {max_views: 12}}}
---
- {name: a, parameters: {steps: {values: [10, 20]}}, by_scene: {town: {operator.c: 0.9}}}
---
- name: a
  settings: {operator: cagrad}
  parameters: {operator.c: {values: [0.2, 0.3]}}
  by_scene: {town: {operator: cagrad, rate_factor: 2}}
---
- name: a
  parameters: {backbone.sh_degree: {values: [0, 1]}}
  by_scene: {town: {backbone: vanilla}}
---
- name: a
  parameters: {operator.c: {values: [0.2, 0.3]}, operator.name: {value: cagrad}}
  by_scene: {town: {operator: {c: 0.9}}}
"""
PLAIN = (
    "{views: 2}, parameters: {operator.c: {value: 0.3}}",
    "{steps: 4}, parameters: {seconds: {value: 1}}",
    "{backbone.sh_degree: 1}, parameters: {backbone: {values: [{sh_degree: 2}]}}",
    "{views: 2}",
)


@pytest.mark.sampled(23)
@pytest.mark.parametrize("arms", CHOICES.split("---"))
@pytest.mark.parametrize("base", ["{backbone: mip}", "{operator: {name: cagrad, c: 0.7}}"])
@pytest.mark.parametrize("fixed", PLAIN)
def test_the_best_arm_has_the_configuration_of_the_best_run(tmp_path, fixed, base, arms):
    path, again = tmp_path / "grid.yaml", tmp_path / "best.yaml"
    plain = f"- {{name: plain, settings: {fixed}}}"
    path.write_text(f"base: {base}\nscenes: [town]\narms:\n{arms.strip()}\n{plain}\n")
    grid = read_grid(path)
    cells = [Job(str(i), each.label, "town", 0, {}) for i, each in enumerate(choices(grid))]
    standings = [
        Standing(job, "finished", summary={"overall": {"psnr": 20.0 + int(job.id)}})
        for job in cells
    ]
    content, _ = best_grid(grid, cells, standings, tmp_path)
    write_mapping(again, content)
    found = {each.arm.name: each for each in choices(read_grid(again))}
    assert list(found) == ["a", "a, best", "plain"]
    new, (_, best, alone) = read_grid(again), choices(grid)
    for name, choice in (("a, best", best), ("plain", alone)):
        scene = grid.scenes[0]
        assert found[name].settings(new.base, scene) == choice.settings(grid.base, scene), name


def test_a_grid_without_varied_parameters_has_no_best_grid(tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text("scenes: [town]\narms: [{name: a}, {name: b}]\n")
    grid = read_grid(path)
    jobs = [Job(each.label, each.label, "town", 0, {}) for each in choices(grid)]
    standings = [Standing(j, "finished", summary={"overall": {"psnr": 20.0}}) for j in jobs]
    with pytest.raises(UserError, match="several values to choose from"):
        best_grid(grid, jobs, standings, tmp_path)


def test_an_arm_without_varied_parameters_must_also_be_finished(swept, tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(GRID + "  - {name: plain, parameters: {rate_factor: {value: 1}}}\n")
    grid, cells, standings = read_grid(path), *swept[1:]
    jobs = [
        Job(f"p{n}", "plain, rate_factor=1", n, s, {}) for n in ("town", "beach") for s in (4, 2)
    ]
    left = [Standing(job, "left") for job in jobs]
    with pytest.raises(UserError, match="before all runs have finished"):
        best_grid(grid, [*cells, *jobs], [*standings, *left], tmp_path)
