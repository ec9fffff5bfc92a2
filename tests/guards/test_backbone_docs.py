"""The pages on backbones and densifiers are complete and name every option."""

import re
from pathlib import Path

import pytest

from crossgrad_core.registry.entries import entries, load

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {"backbones": DOCS / "backbones.md", "densifiers": DOCS / "densifiers.md"}
FIRST = {
    "backbones": ("Represents", "Blocks", "Options", "PLY", "Source"),
    "densifiers": ("Does", "Criteria", "Options", "At the edges", "Source"),
}


def ours(slot):
    return sorted(n for n, e in entries(slot).items() if e.value.startswith("crossgrad_"))


def sections(slot):
    """Name -> lines of its section."""
    parts = re.split(r"^## `(.+)`\n", PAGES[slot].read_text(encoding="utf-8"), flags=re.MULTILINE)
    texts = (text.strip().splitlines() for text in parts[2::2])
    return dict(zip(parts[1::2], texts, strict=True))


BOTH = [(slot, name) for slot in PAGES for name in ours(slot)]


@pytest.mark.parametrize("slot", PAGES)
def test_exactly_the_built_in_components_have_a_section(slot):
    assert list(sections(slot)) == ours(slot)


@pytest.mark.parametrize(("slot", "name"), BOTH)
def test_every_section_has_the_same_lines_in_the_same_order(slot, name):
    lines = sections(slot)[name]
    assert len(lines) == len(FIRST[slot])
    for line, first in zip(lines, FIRST[slot], strict=True):
        assert line.startswith(f"- {first}: ")


@pytest.mark.parametrize(("slot", "name"), BOTH)
def test_a_section_names_every_option_or_the_component_it_is_inherited_from(slot, name):
    (options,) = (line for line in sections(slot)[name] if line.startswith("- Options"))
    named = set(re.findall(r"`([\w-]+)`", options))
    known = set(load(slot, name).model_fields)
    inherited = set()
    for other in named & set(ours(slot)) - {name}:
        inherited |= set(load(slot, other).model_fields)
    assert known - inherited <= named
