"""The field's idiom: module docstrings say what a module is, and code is no person."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = sorted(
    path
    for folder in ("crossgrad_core", "backbones", "operators", "plugins", "examples", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
#: What is written -> what the field says.
WORDS = {
    r"by chance": "at random",
    r"way back": "backward pass",
    r"mood": "state",
    r"whoever": "name the process, the user or the plugin",
    r"somebody else": "another package, another process",
    r"anybody": "any user, any file",
}
FOUND = re.compile(rf"\b({'|'.join(WORDS)})\b", re.IGNORECASE)


def riddles(path):
    """The modules and classes of a file whose docstring does not begin with what they are."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    things = [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    return [
        getattr(each, "name", path.name)
        for each in things
        if (ast.get_docstring(each) or "").startswith("What ")
    ]


def test_modules_and_classes_say_what_they_are():
    """`What X share` and `What is known of X` are riddles; a thing has a name."""
    assert not {str(path.relative_to(ROOT)): found for path in CODE if (found := riddles(path))}


@pytest.mark.parametrize("paths", [CODE, PAGES], ids=["code", "pages"])
def test_words(paths):
    found = [
        f"{path.relative_to(ROOT)}:{number}: {match[0]!r}, say {WORDS[match[0].lower()]!r}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        for match in FOUND.finditer(line)
    ]
    assert not found
