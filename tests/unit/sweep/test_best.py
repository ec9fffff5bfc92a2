"""The grid with the best parameters of each arm and scene."""

import pytest
import yaml

from crossgrad_core.commands import UserError, write_mapping
from crossgrad_plugins.sweep.best import best_grid
from crossgrad_plugins.sweep.grid import choices, read_grid, scene_name
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.standing import Standing

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


def test_each_arm_stands_there_as_it_is_and_at_its_best(swept, tmp_path):
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
        "beach, one: the best rate_factor is 2, at the end of its values",
        "town, two: the best rate_factor is 0.5, at the end of its values",
    ]


def test_less_may_be_better(swept, tmp_path):
    grid, cells, standings = swept
    metric = grid.metric.model_copy(update={"goal": "minimize"})
    content, _ = best_grid(grid.model_copy(update={"metric": metric}), cells, standings, tmp_path)
    assert content["arms"][1]["by_scene"]["beach"] == {"rate_factor": 0.5}


def test_it_is_refused_before_all_is_finished(swept, tmp_path):
    grid, cells, standings = swept
    left = [
        Standing(each.job, "waiting") if each.job.scene == "beach" else each for each in standings
    ]
    with pytest.raises(UserError, match="0 of 3 finished"):
        best_grid(grid, cells, left, tmp_path)
