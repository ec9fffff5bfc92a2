"""Figures that texts give of our experiments are those of the results pages, both experiments."""

import re
from pathlib import Path

import pytest

from crossgrad_core.commands import configured
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.grouping import views_per_step

ROOT = Path(__file__).parents[2]
PAPER, TWO_VIEWS = (
    (ROOT / "docs" / "results" / name).read_text(encoding="utf-8")
    for name in ("paper.md", "two-views.md")
)
#: The tables alone: sentences of a results page are no source.
ROWS = [line for page in (PAPER, TWO_VIEWS) for line in page.splitlines() if line.startswith("|")]
NUMBER = r"[+-]\d+\.\d+"
#: A difference as results pages write it.
DIFFERENCE = re.compile(rf"{NUMBER} dB \({NUMBER} to {NUMBER} dB; n = \d+\)")
EQUAL_DRAWS = "both drawn without replacement."
SECONDS = "Two views per step beat one at equal seconds."


def found_in(text):
    return DIFFERENCE.findall(re.sub(r"\s+", " ", text))


def of_row(words, page=PAPER):
    """The difference in the first row of a results page with these words."""
    return found_in(next(line for line in page.splitlines() if words in line))[0]


def evidence():
    views = [posed_view((i, 0, 0), f"{i}.png") for i in range(3)]
    return views_per_step(Evidence(configured({"scene": "x"}), posed_scene(views))).evidence


def readme():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return text[text.index("One view per step is the default") :].partition("\n## ")[0]


TEXTS = {
    "README.md": readme,
    "crossgrad plan": evidence,
    "two-views.md": lambda: TWO_VIEWS.partition("\n## ")[0],
}


@pytest.mark.parametrize("name", TEXTS)
def test_texts_state_both_experiments_at_equal_rendered_views(name):
    stated = found_in(TEXTS[name]())
    assert of_row(EQUAL_DRAWS) in stated
    assert of_row(SECONDS) in stated
    assert "+0.19 dB" in next(line for line in ROWS if EQUAL_DRAWS in line)
    assert "+0.19 dB" in TEXTS[name]()


@pytest.mark.parametrize("name", ["README.md", "crossgrad plan"])
def test_the_texts_state_the_result_of_the_second_experiment_at_equal_seconds(name):
    best = TWO_VIEWS.partition("## At the best rates")[2]
    assert of_row("| seconds | overall |", best) in found_in(TEXTS[name]())


@pytest.mark.parametrize("name", ["README.md", "crossgrad plan"])
def test_every_number_in_the_texts_is_in_a_results_table(name):
    text = re.sub(r"\s+", " ", TEXTS[name]())
    tables = "\n".join(ROWS)
    assert found_in(text)
    for figure in [*found_in(text), *re.findall(rf"\({NUMBER} dB\)", text)]:
        assert figure in tables, figure
    rest = re.sub(rf"\({NUMBER} dB\)", "", DIFFERENCE.sub("", text))
    assert not re.findall(r"\d\.\d+ dB", rest)
