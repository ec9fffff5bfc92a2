"""Runs of the paper's grids: those that a grid asks for, where its folder has those of others."""

import csv

import pytest
from support.paper_runs import write_run

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.grid import Grid

SEEDS = (1, 2, 3)


def grid(**settings):
    arms = [{"name": "A"}, {"name": "B", "settings": settings}]
    return Grid.model_validate({"scenes": ["/scenes/city"], "seeds": list(SEEDS), "arms": arms})


def write_runs(sweep, prefix, arm="B", **settings):
    """Runs of an arm on all seeds; answers their rows in the table of the sweep."""
    for seed in SEEDS:
        write_run(sweep / "runs" / f"{prefix}{seed}", "city", seed, 20.0, settings=settings)
    return [(f"{prefix}{seed}", "city", arm, seed) for seed in SEEDS]


def write_table(sweep, *rows, columns=("run", "scene", "configuration", "seed")):
    with (sweep / "runs.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *(row for part in rows for row in part)])


def factors(modules, sweep, wanted, **more):
    found = modules.runs.read_results({"x": sweep}, {"x": wanted}, **more)
    by_seed = found.runs.get("B", {})
    return [run.config["rate_factor"] for _, run in sorted(by_seed.items())]


@pytest.mark.parametrize("first", ["a", "z"])
def test_a_changed_grid_uses_its_own_runs_only(modules, tmp_path, first):
    """The order of folder names must not matter, because the names are hashes."""
    old = write_runs(tmp_path, first, rate_factor=2.0)
    new = write_runs(tmp_path, "m", rate_factor=20.0)
    write_table(tmp_path, new, old)
    assert factors(modules, tmp_path, grid(rate_factor=20)) == [20.0] * 3
    # The grid that is asked decides, should another one have been swept last.
    assert factors(modules, tmp_path, grid(rate_factor=2)) == [2.0] * 3


def test_runs_of_an_earlier_grid_do_not_replace_missing_runs(modules, tmp_path):
    old = write_runs(tmp_path, "a", rate_factor=2.0)
    write_table(tmp_path, old)
    found = modules.runs.read_results({"x": tmp_path}, {"x": grid(rate_factor=20)})
    assert not found.runs and found.missing(["B"]) == (3, 3)
    assert [path.name for path in found.left_out["B"]] == ["a1", "a2", "a3"]
    # A change that the grid does not name, as of a default: only the table knows of it.
    write_table(tmp_path, [(f"m{seed}", "city", "B", seed) for seed in SEEDS], old)
    assert factors(modules, tmp_path, grid()) == []


def test_runs_of_another_length_do_not_count_for_the_grid(modules, tmp_path):
    write_table(tmp_path, write_runs(tmp_path, "a", steps=300, rate_factor=2.0))
    assert factors(modules, tmp_path, grid(steps=600)) == []
    assert factors(modules, tmp_path, grid(max_views=300)) == [2.0] * 3
    assert factors(modules, tmp_path, grid(seconds=60)) == []


def test_automatic_settings_and_command_line_settings_match_the_grid(modules, tmp_path):
    write_table(tmp_path, write_runs(tmp_path, "a", rate_factor=2.0))
    assert factors(modules, tmp_path, grid(exposure="auto")) == [2.0] * 3
    more = {"assignments": ["rate_factor=2"]}
    assert factors(modules, tmp_path, grid(rate_factor=20), **more) == [2.0] * 3


def test_two_configurations_of_one_arm_and_seed_are_refused(modules, tmp_path):
    rows = write_runs(tmp_path, "a", rate_factor=2.0) + write_runs(tmp_path, "m", rate_factor=20.0)
    write_table(tmp_path, [(row[0], row[2]) for row in rows], columns=("run", "configuration"))
    with pytest.raises(UserError, match="B has two configurations with seed 1 on city") as error:
        factors(modules, tmp_path, grid())
    assert "a1" in error.value.where and "m1" in error.value.where
    assert error.value.found == "rate_factor 2 against 20"


def test_failed_runs_of_an_earlier_grid_do_not_count(modules, tmp_path):
    for seed in SEEDS:
        folder = tmp_path / "runs" / f"a{seed}"
        write_run(folder, "city", seed, 20.0, status="failed", settings={"rate_factor": 2.0})
    write_table(tmp_path, [(f"a{seed}", "city", "B", seed) for seed in SEEDS])
    for factor, missing in ((20, 3), (2, 0)):
        found = modules.runs.read_results({"x": tmp_path}, {"x": grid(rate_factor=factor)})
        assert found.missing(["B"]) == (3, missing)
