"""The core names no plugin, except in defaults.py."""

import ast
import re

import pytest
from support.imports import CORE, ROOT

from crossgrad_core import defaults
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import OFFERED, PLANNERS

#: Names of plugins that are ordinary words as well: of a text, of a setting, of a library.
WORDS = {
    *(
        "active",
        "analytic",
        "anchors",
        "auto",
        "channel",
        "chain",
        "distance",
        "epoch",
        "footprint",
        "horizon",
        "lists",
    ),
    *("mean", "mip", "none", "numba", "pixel", "ply", "progress", "psnr", "random", "soft", "ssim"),
    *("splat", "view"),
    *("full", "html", "nerfstudio", "points", "published", "sum", "torch"),
}
FILES = [path for path in sorted((ROOT / CORE).rglob("*.py")) if path.name != "defaults.py"]
NAMES = {
    entry.name
    for slot in OFFERED
    for entry in registry.offers(slot)
    if entry.distribution == "crossgrad" and slot != "commands"
}
#: Calls whose argument is the name of a plugin -> which argument.
NAMING = {"build": 1, "load": 1, "find": 1, "ComponentChoice": 0}


def named(source):
    """(line, name) wherever a source names a plugin."""
    tree = ast.parse(source)
    texts = {id(node.body[0].value) for node in ast.walk(tree)
             if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
             and isinstance(node.body[0], ast.Expr)}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in texts:
            for name in sorted(NAMES - WORDS):
                if re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", node.value):
                    yield node.lineno, name
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in NAMING:
            place = NAMING[node.func.id]
            given = [
                *node.args[place : place + 1],
                *(k.value for k in node.keywords if k.arg == "name"),
            ]
            yield from (
                (node.lineno, each.value)
                for each in given
                if isinstance(each, ast.Constant) and isinstance(each.value, str)
            )
        elif isinstance(node, ast.Compare) and _is_name(node.left):
            literals = [each.value for each in node.comparators if isinstance(each, ast.Constant)]
            yield from ((node.lineno, each) for each in literals if each in NAMES)


def _is_name(node):
    """`choice.name`, or `names["densifier"]`."""
    attribute = isinstance(node, ast.Attribute) and node.attr == "name"
    value = getattr(node, "value", None)
    names = "names" in {getattr(value, "attr", ""), getattr(value, "id", "")}
    return attribute or (isinstance(node, ast.Subscript) and names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / CORE)))
def test_core_files_contain_no_plugin_names(path):
    assert not list(named(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    "source",
    [
        'build("rasterizers", "torch", {})',
        'ComponentChoice(name="random")',
        'x = choice.name != "progress"',
        'x = selection.names["densifier"] == "none"',
        'todo = f"use --sampler near-far {x}"',
    ],
)
def test_the_guard_finds_the_name_of_a_plugin(source):
    assert list(named(source))


def test_each_default_component_is_installed():
    own = {name: value for name, value in vars(defaults).items() if name.isupper()}
    for value in own.values():
        names = value.split("+") if isinstance(value, str) else value
        assert set(names) <= {*NAMES, *registry.entries(PLANNERS)}
