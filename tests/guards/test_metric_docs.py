"""docs/metrics.md lists every metric with its key and whether a run measures it by default."""

import re
from pathlib import Path

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.registry.entries import build, entries

PAGE = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text(encoding="utf-8")
OURS = sorted(n for n, e in entries("metrics").items() if e.value.startswith("crossgrad_"))
FOUND = re.findall(r"^\| `(.+?)` \| `(.+?)` \| (.+?) \|", PAGE, re.MULTILINE)
ROWS = {name: cells for name, *cells in FOUND}
BY_DEFAULT = {choice.name for choice in RunConfig().metrics}


def test_each_metric_has_a_row_and_rows_are_in_order():
    assert list(ROWS) == OURS


@pytest.mark.parametrize("name", OURS)
def test_the_row_of_a_metric_has_its_key_and_default(name):
    key, default = ROWS[name]
    metric = build("metrics", name, {})
    assert key == metric.figure.name
    assert default.startswith("yes") == (name in BY_DEFAULT)


@pytest.mark.parametrize("name", OURS)
def test_the_metrics_page_documents_every_option(name):
    for option in type(build("metrics", name, {})).model_fields:
        assert f"- `{option}`: " in PAGE
