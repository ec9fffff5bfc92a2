"""docs/resolutions.md is complete: every built-in resolution, every option with its default."""

import re
from pathlib import Path

import pytest

from crossgrad_core.registry.entries import build, entries

PAGE = (Path(__file__).parents[2] / "docs" / "resolutions.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## `(\S+)`\n((?:(?!^## ).*\n?)*)", PAGE, re.MULTILINE))
OURS = sorted(n for n, e in entries("resolutions").items() if e.value.startswith("crossgrad_p"))


def test_exactly_the_built_in_resolutions_have_a_section_and_a_row():
    rows = re.findall(r"^\| `(\S+)` \|", PAGE, re.MULTILINE)
    assert sorted(SECTIONS) == sorted(rows) == OURS


@pytest.mark.parametrize("name", OURS)
def test_every_option_is_explained_with_its_default(name):
    (line,) = re.findall(r"^- Options: (.*)$", SECTIONS[name], re.MULTILINE)
    resolution = build("resolutions", name, {})
    told = dict(re.findall(r"`(\w+)` \(([\w.]+)", line))
    fields = type(resolution).model_fields
    defaults = {n: "none" if f.default is None else f"{f.default:g}" if isinstance(f.default, float)
                else str(f.default) for n, f in fields.items()}  # fmt: skip
    assert told == defaults


@pytest.mark.parametrize("name", OURS)
def test_every_section_names_its_source(name):
    assert re.search(r"^- Source: \S", SECTIONS[name], re.MULTILINE)
