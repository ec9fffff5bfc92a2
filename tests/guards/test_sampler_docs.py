"""The pages on samplers and groupings are complete and true."""

import re
from pathlib import Path

import pytest

from crossgrad_core.registry.entries import build, entries

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {"samplers": DOCS / "samplers.md", "groupings": DOCS / "groupings.md"}
LINES = 5


def ours(slot):
    """Names of the built-in components; third parties have pages of their own."""
    return sorted(n for n, e in entries(slot).items() if e.value.startswith("crossgrad_"))


def sections(slot):
    """Name -> text of its section."""
    parts = re.split(r"^## `(.+)`\n", PAGES[slot].read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows(slot):
    """Name -> the other cells of its row in the page's table."""
    lines = PAGES[slot].read_text(encoding="utf-8").splitlines()
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in lines if line[:3] == "| `"]
    return {row[0].strip("`"): row[1:] for row in cells}


BOTH = [(slot, name) for slot in PAGES for name in ours(slot)]


@pytest.mark.parametrize("slot", PAGES)
def test_exactly_the_built_in_components_have_a_section_and_a_row(slot):
    assert sorted(sections(slot)) == list(sections(slot)) == ours(slot)
    assert list(rows(slot)) == ours(slot)


@pytest.mark.parametrize(("slot", "name"), BOTH)
def test_a_section_has_five_lines_and_names_every_option(slot, name):
    text = sections(slot)[name].strip()
    assert len(text.splitlines()) == LINES
    assert all(line.startswith("- ") for line in text.splitlines())
    for option in type(build(slot, name, {})).model_fields:
        assert f"`{option}`" in text
    assert text.splitlines()[-1].startswith("- Source:")


@pytest.mark.parametrize("name", ours("samplers"))
def test_the_sampler_table_shows_numbers_of_views_and_default_groupings(name):
    sampler = build("samplers", name, {})
    grouping = f"`{sampler.default_grouping}`" if sampler.default_grouping else "none"
    assert rows("samplers")[name] == [str(sampler.views), str(sampler.default_views), grouping]


@pytest.mark.parametrize("name", ours("groupings"))
def test_the_grouping_table_shows_the_labels(name):
    labels = build("groupings", name, {}).labels
    assert rows("groupings")[name][0] == (", ".join(labels) if labels else "the user's")


@pytest.mark.parametrize("name", ours("samplers"))
def test_default_groupings_exist_for_all_samplers(name):
    default = build("samplers", name, {}).default_grouping
    assert default is None or default in ours("groupings")
