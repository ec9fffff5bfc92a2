"""The basic loop knows no rule by name, and the page about rules names each of them."""

import re

import pytest
from support.imports import ROOT

from crossgrad_core.registry.entries import entries, load

RULES = sorted(n for n, e in entries("rules").items() if e.distribution == "crossgrad")
PAGE = (ROOT / "docs" / "rules.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("package", ["training", "run", "registry", "recipe", "gradients"])
def test_the_core_names_no_rule(rule, package):
    name = re.compile(re.escape(rule).replace(r"\-", "[-_ ]?"), re.IGNORECASE)
    sources = sorted((ROOT / "crossgrad_core" / package).rglob("*.py"))
    naming = [path.name for path in sources if name.search(path.read_text(encoding="utf-8"))]
    assert sources and not naming


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_has_a_row_with_its_options_and_their_defaults(rule):
    (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| `rules.{rule}` |"))
    for name, field in load("rules", rule).model_fields.items():
        assert f"`{name}` ({field.default})" in row


def test_every_row_belongs_to_an_existing_rule():
    assert sorted(re.findall(r"^\| `rules\.(.+?)` \|", PAGE, re.MULTILINE)) == RULES
