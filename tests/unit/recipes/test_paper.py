"""The recipes of the paper's arms resolve to the settings of the grids that ran them."""

import pytest
from support.imports import ROOT

from crossgrad_core.commands import configured, layered
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.sweep.grid import read_grid

GRIDS = ROOT / "benchmarks" / "grids" / "paper"
#: Recipe -> its grid and arm.
ARMS = {
    "paper/vanilla-30k": ("views", "one view, 1x"),
    "paper/vanilla-60k": ("views", "one view, 2x stretched"),
    "paper/r2view": ("views", "two random views"),
    "paper/balanced": ("pairing", "near and far by turns"),
    "paper/near-far": ("pairing", "near-far"),
    "paper/crossgrad": ("operators", "symmetric"),
    "paper/cagrad": ("operators", "cagrad"),
    "paper/gradnorm": ("operators", "gradnorm"),
    "paper/confgate": ("operators", "confgate v2"),
    "paper/preconditioner": ("operators", "preconditioner"),
}


def settings_of(config):
    written = resolved(assemble(config, sample_scene(), "none")).model_dump(mode="json")
    return {name: each for name, each in written.items() if name not in {"recipe", "decided"}}


def test_each_recipe_of_the_paper_has_a_grid():
    assert {name for name in entries("recipes") if name.startswith("paper/")} == {*ARMS}


@pytest.mark.parametrize("name", ARMS)
def test_a_recipe_has_the_settings_of_its_arm(name):
    file, arm = ARMS[name]
    grid = read_grid(GRIDS / f"{file}.yaml")
    (settings,) = (each.settings for each in grid.arms if each.name == arm)
    wanted = configured({**layered([grid.base, settings]), "scene": "sample"})
    found = configured({"recipe": {"name": name}, "scene": "sample"})
    assert settings_of(found) == settings_of(wanted)


def test_settings_of_the_user_override_the_recipe_and_its_length():
    recipe = {"recipe": {"name": "paper/crossgrad"}, "scene": "sample"}
    config = configured({**recipe, "operator": {"name": "cagrad", "c": 0.3}, "steps": 50})
    assert (config.operator.name, config.operator.options["c"]) == ("cagrad", 0.3)
    assert (config.steps, config.max_views) == (50, None)
    assert config.data.max_size == 400
