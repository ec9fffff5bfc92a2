"""The example package has one plugin for every slot and one command, all of them short."""

import ast
import tomllib

import pytest
from support.imports import ROOT

from crossgrad_core.registry.slots import OFFERED

EXAMPLE = ROOT / "examples" / "plugin"
PROJECT = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
GROUPS = PROJECT["entry-points"]
PUBLIC = ("plugin", "numerics", "commands", "scene", "testing")


def lines(group):
    """Lines of a plugin's module that are not empty."""
    (value,) = GROUPS[group].values()
    source = EXAMPLE / f"{value.partition(':')[0].replace('.', '/')}.py"
    return [line for line in source.read_text(encoding="utf-8").splitlines() if line.strip()]


def test_the_example_has_one_plugin_for_every_slot_and_one_command():
    assert set(GROUPS) == set(OFFERED.values())
    assert all(len(named) == 1 for named in GROUPS.values())


def test_the_example_operator_has_12_lines():
    assert len(lines("crossgrad.operators")) <= 12


def test_the_example_densifier_has_40_lines():
    assert len(lines("crossgrad.densifiers")) <= 40


def test_the_example_rule_has_at_most_30_lines_and_40_with_recipe_and_documentation():
    readme = (EXAMPLE / "README.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in readme if line.startswith(("| recipe |", "| rule |"))]
    rule, recipe = lines("crossgrad.rules"), lines("crossgrad.recipes")
    assert len(rows) == 2 and len(rule) <= 30
    assert len(rule) + len(recipe) + len(rows) <= 40


@pytest.mark.parametrize("file", sorted((EXAMPLE / "crossgrad_example").glob("*.py")), ids=str)
def test_the_example_package_imports_public_modules_only(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("crossgrad_"):
            package, *rest = node.module.split(".")
            assert package == "crossgrad_example" or rest[0] in PUBLIC
