"""The page on operators is complete and true."""

import re
from math import sqrt
from pathlib import Path

import pytest

from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.support.aggregation import aggregate_context, sample_gradients
from crossgrad_core.training.setup import OperatorScale

PAGE = (Path(__file__).parents[2] / "docs" / "operators.md").read_text(encoding="utf-8")
STARTS = ("- Formula:", "- Differs from `sum`:", "- At the edges:", "- Options:", "- Source:")
#: Built-in operators; third parties have pages of their own.
OURS = sorted(n for n, e in entries("operators").items() if e.value.startswith("crossgrad_"))


def sections():
    """Name -> text of its section."""
    parts = re.split(r"^## `(.+)`\n", PAGE, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows():
    """Name -> the other cells of its row in the table."""
    lines = [line for line in PAGE.split("## Scale")[0].splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0].strip("`"): row[1:] for row in cells}


def test_exactly_the_built_in_operators_have_a_section_and_a_row():
    assert list(sections()) == OURS
    assert list(rows()) == OURS


@pytest.mark.parametrize("name", OURS)
def test_a_section_has_its_five_lines_and_names_every_option(name):
    lines = sections()[name].strip().splitlines()
    assert len(lines) == len(STARTS)
    assert all(line.startswith(start) for line, start in zip(lines, STARTS, strict=True))
    options = set(type(build("operators", name, {})).model_fields) - {"granularity"}
    assert all(f"`{option}`" in lines[3] for option in options)
    assert lines[3].startswith("- Options: none") == (not options)


def test_the_table_of_operator_scales_is_correct():
    lines = PAGE.split("| c(K) | operators |")[1].split("\n\n")[0].splitlines()[2:]
    known = {"K": lambda k: k, "1": lambda _: 1, "sqrt(K)": sqrt, "1 + c, 1 for K = 1": _cagrad}
    named = []
    for formula, names in (line.strip("| ").split(" | ") for line in lines):
        named += (operators := re.findall(r"`(.+?)`", names))
        if formula in known:
            expected = [known[formula](views) for views in (1, 2, 3, 5)]
            for name in operators:
                found = [_scale(name, views) for views in (1, 2, 3, 5)]
                assert [f or e for f, e in zip(found, expected, strict=True)] == pytest.approx(
                    expected
                )
    assert sorted(named) == OURS


def _cagrad(views):
    return 1.5 if views > 1 else 1


def _scale(name, views):
    """c(K), or None where K is refused."""
    operator = build("operators", name, {})
    if not operator.views.admits(views):
        return None
    scale = OperatorScale(operator).of(aggregate_context(sample_gradients(views)))
    return scale.per_step["means"]


@pytest.mark.parametrize("name", OURS)
def test_the_operator_table_shows_the_accepted_numbers_of_views(name):
    operator = build("operators", name, {})
    one, two, more, apart, _ = rows()[name]
    admitted = [operator.views.admits(views) for views in (1, 2, 3)]
    assert [cell != "refused" for cell in (one, two, more)] == admitted
    assert apart == ("yes" if operator.separate else "no")


@pytest.mark.parametrize("name", OURS)
def test_the_operator_table_marks_operators_that_do_not_change_a_single_view(name):
    one = rows()[name][0]
    if not one.startswith("as its") and one != "as the weighting":
        assert (one == "g_1") == build("operators", name, {}).is_identity(1)
