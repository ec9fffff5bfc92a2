"""A run that was killed before its first checkpoint begins again from its configuration."""

import json
import os
import shutil

import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.postprocess import evaluate, export
from crossgrad_core.run.results.lock import locked
from crossgrad_core.run.results.metrics_csv import read_metrics

MEASURED = {"psnr", "ssim", "ssim_skimage", "primitives", "loss", "views"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing disturbs."""
    root = tmp_path_factory.mktemp("whole")
    scene = write_tiny_scene(root / "tiny", views=9)
    settings = {
        "scene": str(scene), "out": str(root / "run"), "steps": 6, "eval_every": 2, "seed": 3,
        "sampler": {"name": "near-far"}, "background": "random",
    }  # fmt: skip
    assert app.run(settings, verbosity=-1) == 0
    return root / "run"


@pytest.fixture
def killed(whole, tmp_path):
    """The same, killed after its first evaluation and before its first checkpoint."""
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(whole / "config.yaml", out)
    lines = (whole / "metrics.csv").read_text().splitlines(keepends=True)
    (out / "metrics.csv").write_text("".join(lines[:2]))
    (out / "checkpoints" / ".scratch-step-000002").mkdir(parents=True)
    (out / ".log.txt.123.tmp").write_text("half")
    return out


def measured(out):
    return [{name: row[name] for name in MEASURED} for row in read_metrics(out)]


def test_a_run_without_a_checkpoint_is_restarted_with_a_note(whole, killed):
    assert app.run({}, resume=killed, verbosity=-1) == 0
    ours, theirs = load(latest(killed)), load(latest(whole))
    assert all(torch.equal(ours.parameters[name], theirs.parameters[name])
               for name in theirs.parameters)  # fmt: skip
    assert ours.generators == theirs.generators
    assert measured(killed) == measured(whole)
    words = "no checkpoint yet: the run starts again from its configuration"
    assert words in (killed / "log.txt").read_text()
    assert words in json.loads((killed / "summary.json").read_text())["notes"]
    assert {path.name for path in killed.iterdir()} == {path.name for path in whole.iterdir()}


def test_a_run_killed_before_its_metrics_file_is_restarted(whole, killed):
    (killed / "metrics.csv").unlink()
    assert app.run({"stop_after": 2}, resume=killed, verbosity=-1) == 0
    assert measured(killed) == measured(whole)[:1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("stop", [1, 2, 10_000])
def test_a_stop_step_in_the_past_or_after_the_end_is_refused(killed, stop):
    assert app.run({"stop_after": 2}, resume=killed, verbosity=-1) == 0
    before = (killed / "log.txt").read_bytes()
    where = "already passed" if stop < 3 else "after the end of the run"
    with pytest.raises(UserError, match=rf"{where}(.|\n)*a step from 3 to (.|\n)*found: +{stop}"):
        app.run({"stop_after": stop}, resume=killed, verbosity=-1)
    assert (killed / "log.txt").read_bytes() == before
    assert app.run({"stop_after": 3}, resume=killed, verbosity=-1) == 0


def test_a_restarted_run_keeps_its_settings(killed):
    with pytest.raises(UserError, match="settings cannot be changed"):
        app.run({"seed": 4}, resume=killed, verbosity=-1)


def test_a_run_killed_before_its_first_checkpoint_cannot_be_evaluated(killed):
    for look in (
        evaluate.evaluate,
        lambda run: export.export(run, file_format="ply", out=None),
    ):
        with pytest.raises(UserError, match=rf"no checkpoint yet(.|\n)*--resume {killed}"):
            look(killed)
    with (
        locked(killed, "training"),
        pytest.raises(
            UserError, match=rf"process {os.getpid()}(.|\n)*wait for the first checkpoint"
        ),
    ):
        evaluate.evaluate(killed)


def test_a_new_run_into_the_folder_of_a_killed_run_is_refused(killed):
    settings = {"scene": "nowhere", "out": str(killed), "steps": 2}
    with pytest.raises(UserError, match="resume that run with --resume"):
        app.run(settings, verbosity=-1)
