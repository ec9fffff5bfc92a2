"""A grouping by gradients in one command: new groups at a step, the same bits after a stop."""

import json

import pytest
from support.same_bits import bits
from support.scenes import write_tiny_scene

import crossgrad_core as cg

OPTIONS = {
    "sampler": "near-far", "operator": "pcgrad", "steps": 20, "grouping": "conflict-signature",
    "sampler.order": "epoch", "eval_every": 20,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def run(scene, out, **options):
    return cg.run(scene, out=out, quiet=True, **{**OPTIONS, "grouping.at": 9, **options})


def known_labels(run):
    checkpoint = max((run.folder / "checkpoints").glob("step-*"))
    return json.loads((checkpoint / "state.json").read_text())["plugins"].get("grouping")


def test_views_are_regrouped_and_a_stopped_run_has_the_same_bits(scene, tmp_path):
    whole = run(scene, tmp_path / "whole")
    parts = run(scene, tmp_path / "parts", stop_after=13)
    assert known_labels(parts) is not None
    whole_bits, parts_bits = (
        bits(each.folder, {"20"}) for each in (whole, cg.resume(parts.folder, quiet=True))
    )
    assert parts_bits == whole_bits
    assert "by gradients after step 9" in (whole.folder / "summary.json").read_text()


def test_a_run_that_ends_before_regrouping_keeps_its_first_groups(scene, tmp_path):
    early = run(scene, tmp_path / "early", **{"grouping.at": 50})
    assert known_labels(early) is None
