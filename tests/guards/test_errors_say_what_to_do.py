"""Every error that a user can cause says what to do about it."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ERRORS = {"UserError", "IncompatibleSelectionError"}
SOURCES = [
    path
    for folder in ("crossgrad_core", "backbones", "operators", "plugins")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if any(f"{error}(" in path.read_text(encoding="utf-8") for error in ERRORS)
]


def raised(path: Path) -> list[ast.Call]:
    """The calls in a file that make an error for the user."""
    found = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    calls = [node for node in found if isinstance(node, ast.Call)]
    return [c for c in calls if isinstance(c.func, ast.Name) and c.func.id in ERRORS]


def told(call: ast.Call) -> ast.expr | None:
    return next((keyword.value for keyword in call.keywords if keyword.arg == "todo"), None)


def can_be_empty(value: ast.expr | None) -> bool:
    """Whether a text is missing, empty, or empty in one of two cases."""
    if value is None:
        return True
    if isinstance(value, ast.IfExp):
        return can_be_empty(value.body) or can_be_empty(value.orelse)
    # A suggestion alone is empty where nothing resembles what was typed.
    alone = isinstance(value, ast.Call) and ast.unparse(value.func) == "did_you_mean"
    return alone or (isinstance(value, ast.Constant) and not value.value)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_every_error_suggests_a_remedy(path):
    silent = [f"line {call.lineno}" for call in raised(path) if can_be_empty(told(call))]
    assert not silent


def test_the_guard_finds_more_than_100_errors():
    assert sum(len(raised(path)) for path in SOURCES) > 100
