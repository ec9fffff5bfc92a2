"""Docstrings of modules and classes begin with what the module or class is."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
CODE = sorted(
    path
    for folder in ("crossgrad_core", "backbones", "operators", "plugins", "examples", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
)


def riddles(path):
    """The modules and classes of a file whose docstring does not begin with what they are."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    things = [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    return [
        getattr(each, "name", path.name)
        for each in things
        if (ast.get_docstring(each) or "").startswith("What ")
    ]


def test_module_and_class_docstrings_name_their_subject():
    """Refuse docstrings such as `What X share`, because they name no subject."""
    assert not {str(path.relative_to(ROOT)): found for path in CODE if (found := riddles(path))}
