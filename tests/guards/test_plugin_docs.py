"""The code shown in docs/plugins.md and in the README of the example works."""

import re
import tomllib
from pathlib import Path

import pytest

from crossgrad_core import plugin
from crossgrad_core.registry.slots import GROUPS, OFFERED
from crossgrad_core.testing.checking import checks_of
from crossgrad_core.wording import singular

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", GUIDE, re.DOTALL)


@pytest.fixture(scope="module")
def shown():
    """The names that the guide's code defines."""
    names = {"__name__": "shown_in_the_guide"}
    for code in blocks("python"):
        exec(code, names)
    return names


def test_the_operator_on_the_page_keeps_the_contract(shown):
    for check in checks_of("operators"):
        check(shown["EqualLength"])
        check(lambda: shown["EqualLength"](share=0.5))


def test_the_test_on_the_page_is_parametrized_by_the_checks(shown):
    (mark,) = shown["test_equal_length"].pytestmark
    assert mark.args == ("check", checks_of("operators"))


def test_the_operator_on_the_page_has_20_lines():
    assert len([line for line in blocks("python")[0].splitlines() if line]) <= 20


def test_the_report_on_the_page_counts_the_checks():
    assert f"pass  {len(checks_of('operators'))} checks" in GUIDE


def test_the_entry_points_on_the_page_are_in_existing_groups():
    for text in blocks("toml"):
        groups = tomllib.loads(text)["project"]["entry-points"]
        assert groups.keys() <= set(OFFERED.values())


@pytest.mark.parametrize("slot", list(GROUPS))
def test_each_slot_is_listed_with_group_base_class_and_methods(slot):
    word = singular(slot)
    row = re.search(rf"^\| {word} \| `([\w.]+)` \| `(\w+)` \| (.*) \|$", GUIDE, re.MULTILINE)
    base = getattr(plugin, row[2])
    assert row[1] == GROUPS[slot]
    assert base.slot == slot
    missing = set(base.__abstractmethods__) - set(re.findall(r"`(\w+)`", row[3]))
    assert not missing


def test_the_page_lists_the_complete_public_interface():
    # pytest adds names that begin with @ to the modules of packages that bring a plugin of pytest.
    public = {name for name in vars(plugin) if not name.startswith(("_", "@"))}
    assert public == set(plugin.__all__)


def test_entry_points_of_the_example_name_its_own_plugins():
    example = ROOT / "examples" / "plugin"
    project = tomllib.loads((example / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    readme = (example / "README.md").read_text(encoding="utf-8")
    for group in project["entry-points"].values():
        for name, value in group.items():
            assert f"`{name}`" in readme
            module, _, kind = value.partition(":")
            source = example / f"{module.replace('.', '/')}.py"
            assert re.search(
                rf"^(class|def) {kind}\(", source.read_text(encoding="utf-8"), re.MULTILINE
            )
