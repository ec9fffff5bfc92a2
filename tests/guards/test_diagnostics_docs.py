"""docs/diagnostics.md names every column that a report has."""

import re
from pathlib import Path

import numpy as np
import pytest

from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.diagnostics.exposure import exposure_of
from crossgrad_plugins.diagnostics.plan import labelled, plan_probe
from crossgrad_plugins.diagnostics.probe import Measurement
from crossgrad_plugins.diagnostics.table import table
from crossgrad_plugins.diagnostics.watch import camera_rows, distances_of, grouping_rows

PAGE = Path(__file__).parents[2] / "docs" / "diagnostics.md"


def columns():
    scene = sample_scene()
    labels, _ = labelled(scene, "radial", 0)
    plan = plan_probe(scene, "radial", labels, 12, 0)
    rows = np.random.default_rng(0).normal(size=(1, len(plan.views), 5))
    gramians = rows @ rows.swapaxes(1, 2)
    overlap = np.ones(gramians.shape, dtype=bool)
    measurement = Measurement(
        1, plan.views, ("means",), ("geometry",), gramians, None, overlap, (), 1.0
    )
    found = [
        *table(measurement, plan, distances_of(scene), 0),
        *camera_rows(scene),
        *grouping_rows(scene, measurement, 0),
        *exposure_of(scene).rows,
    ]
    return sorted({name for row in found for name in row} - {"note", "quantity"})


@pytest.fixture(scope="module")
def named():
    text = PAGE.read_text(encoding="utf-8")
    names = set(re.findall(r"`(\w+)`", text))
    for first, last in re.findall(r"`(\w+bin)1` to `\1(\d)`", text):
        names |= {f"{first}{number}" for number in range(1, int(last) + 1)}
    return names


@pytest.mark.parametrize("column", columns())
def test_the_diagnostics_page_explains_each_column(named, column):
    assert column in named
