"""docs/hooks.md names every hook with its arguments, and every hook is named by a test."""

import inspect
import re
from pathlib import Path

import pytest

from crossgrad_core.contract.hooks import HookSpecs

ROOT = Path(__file__).parents[2]
HOOKS = {
    name: [argument for argument in inspect.signature(hook).parameters if argument != "self"]
    for name, hook in vars(HookSpecs).items()
    if name.startswith("crossgrad_")
}
HEADING = re.compile(r"^#+ `(crossgrad_\w+)\(([\w, ]*)\)`$", re.MULTILINE)


@pytest.fixture(scope="module")
def headings():
    text = (ROOT / "docs" / "hooks.md").read_text(encoding="utf-8")
    return {name: arguments.split(", ") for name, arguments in HEADING.findall(text)}


def test_the_hook_specifications_are_found():
    assert "crossgrad_densify" in HOOKS


@pytest.mark.parametrize("hook", HOOKS)
def test_each_hook_is_documented_with_its_arguments(headings, hook):
    assert headings[hook] == HOOKS[hook]


def test_every_documented_hook_exists(headings):
    assert headings.keys() == HOOKS.keys()


def test_hooks_are_documented_in_the_order_of_their_calls(headings):
    assert list(headings) == list(HOOKS)


@pytest.mark.parametrize("hook", HOOKS)
def test_each_hook_is_named_by_a_test(hook):
    tests = [path for path in ROOT.glob("tests/**/*.py") if path != Path(__file__)]
    assert any(hook in path.read_text(encoding="utf-8") for path in tests)
