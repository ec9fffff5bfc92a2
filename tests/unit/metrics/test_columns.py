"""Folders of photos whose names make two columns of metrics.csv one."""

from dataclasses import replace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.defaults import METRICS
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.session import columns_of
from crossgrad_core.testing.fixtures import sample_scene

USUAL = METRICS.split("+")


def assembled(regimes, names=()):
    """A run on a scene whose photos lie in such folders, with further metrics."""
    scene = sample_scene()
    views = list(scene.views)
    for number, each in enumerate(scene.test):
        views[each] = replace(views[each], regime=regimes[number % len(regimes)])
    settings = {"steps": 4, "metrics": [{"name": name} for name in (*USUAL, *names)]}
    config = RunConfig.model_validate(settings)
    return assemble(config, replace(scene, views=tuple(views)), "none")


@pytest.mark.parametrize(
    ("regimes", "left_out"),
    [
        (["near", "far"], ()),
        (["track"], ["psnr-track"]),
        (["cc"], ["psnr-cc"]),
        (["a", "track_a"], ["psnr-track"]),
        (["skimage", "cc"], ["ssim-skimage", "psnr-cc"]),
    ],
    ids="+".join,
)
def test_default_metrics_with_a_duplicate_column_are_left_out(regimes, left_out):
    setup = assembled(regimes)
    columns = columns_of(setup)
    assert len(set(columns)) == len(columns)
    assert [n for n in USUAL if n not in left_out] == list(setup.selection.metrics)
    said = [note for note in setup.notes if "is not computed: metrics.csv already has" in note]
    assert [note.split()[1] for note in said] == list(left_out)
    # A run that goes on has the same table, and nothing to say.
    again = assemble(resolved(setup), setup.scene, "none")
    assert columns_of(again) == columns
    assert not [note for note in again.notes if "left out" in note]


def test_a_metric_with_a_duplicate_column_that_the_user_names_is_refused():
    with pytest.raises(UserError, match="ssim_cc") as caught:
        assembled(["cc"], ["ssim-cc"])
    assert "leave metric ssim-cc out" in caught.value.todo
