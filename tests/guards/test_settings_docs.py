"""docs/settings.md names every setting of a run, with its option and its default."""

import re
from pathlib import Path

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene
from typer.main import get_command

from crossgrad_core.cli.main import app
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.system.yaml_values import read_mapping

PAGE = (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")
MODELS = {"run": RunConfig, "data": SceneOptions}
FIELDS = [(model, name) for model in MODELS for name in MODELS[model].model_fields]


def rows(text):
    """Setting -> option, default and meaning."""
    cells = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \| (.+) \|$", text, re.MULTILINE)
    return {name: rest for name, *rest in cells}


BEFORE, _, AFTER = PAGE.partition("## Reading")
TABLES = {"run": rows(BEFORE), "data": rows(AFTER)}


@pytest.fixture(scope="module")
def options():
    """The options of `crossgrad run` by the setting that they are for."""
    parameters = get_command(app).commands["run"].params
    return {each.name: each.opts[0] for each in parameters} | {
        "observers": "--observe",
        "rules": "--rule",
        "views_per_step": "--views",
    }


@pytest.mark.parametrize("model", MODELS)
def test_settings_have_rows_in_the_order_of_the_schema(model):
    assert list(TABLES[model]) == list(MODELS[model].model_fields)


@pytest.mark.parametrize(("model", "name"), FIELDS)
def test_a_row_names_the_command_line_option_of_its_setting(model, name, options):
    option = TABLES[model][name][0].strip("`")
    expected = {"scene": "SCENE"}.get(name) or options.get(name, "-")
    assert option == expected


@pytest.mark.parametrize(("model", "name"), FIELDS)
def test_a_row_names_the_schema_default_of_its_setting(model, name):
    default = MODELS[model].model_fields[name].default
    stated = TABLES[model][name][1]
    if isinstance(default, ComponentChoice):
        default = default.name
    if isinstance(default, str | int | float):
        assert stated == f"`{default}`"
    else:  # Decided at the start of the run: in words.
        assert not re.fullmatch(r"`\w+`", stated)


def empty_settings(config, prefix=""):
    """Yield the names of the settings that are null, without the index of a list."""
    for name, value in config.items() if isinstance(config, dict) else ():
        if value is None:
            yield f"{prefix}{name}"
        for inner in value if isinstance(value, list) else [value]:
            yield from empty_settings(inner, f"{prefix}{name}.")


def test_null_in_a_finished_configuration_is_documented(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=8, points=120)
    out = tmp_path / "run"
    assert ended("run", scene, "--steps", 2, "--rasterizer", "torch", "-q", "--out", out) == 0
    config = read_mapping(out / "config.yaml", "a configuration", "repair it")
    section = PAGE.split("`null` in the config.yaml", 1)[1].split("Options of a component", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    documented = {name for row in rows for name in re.findall(r"`([^`]+)`", row.split("|")[1])}
    assert set(empty_settings(config)) <= documented
