"""However a run ends, what it has is kept, it says why, and it goes on to the undisturbed bits."""

import csv
import json
import os
import signal
import threading
from dataclasses import replace

import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.contract.blocks import Edit, Rows
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import DensifyResult
from crossgrad_core.errors import UserError
from crossgrad_core.run import app, assemble, session
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.results.metrics_csv import read_metrics
from crossgrad_core.scene.photos import photos_ahead
from crossgrad_plugins.exporters.ply_file import read_ply
from crossgrad_plugins.rules.floaters import Floaters

STEPS, FAILS_IN = 8, 5
RESULTS = {"per_view.csv", "curve.png", "renders", "point_cloud.ply", "summary.json"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def run(scene, out, **further):
    settings = {"scene": str(scene), "out": str(out), "steps": STEPS, "eval_every": 4, "threads": 1}
    # A filled start would look at all photos before the first step.
    settings["initializer"] = {"name": "points"}
    settings |= {"sampler": {"name": "random"}, "views": 2, **further}
    return app.run(settings, verbosity=-1)


def resumed(out):
    return app.run({}, resume=out, verbosity=-1)


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """A run that nothing disturbs."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run(scene, out) == 0
    return out


@pytest.fixture
def with_plugin(monkeypatch):
    """Adds a plugin to the runs of a test, until it is taken out again."""
    original = assemble._plugins
    plugins = {}
    monkeypatch.setattr(assemble, "_plugins", lambda *args: {**original(*args), **plugins})
    return plugins


def summary(out):
    return json.loads((out / "summary.json").read_text())


def rows(out):
    with (out / "metrics.csv").open() as file:
        return {row["step"]: (row["psnr"], row["loss"]) for row in csv.DictReader(file)}


def assert_same(out, whole):
    """Equal states and, at the steps of the undisturbed run, equal rows."""
    ours, theirs = load(latest(out)), load(latest(whole))
    assert ours.step == theirs.step == STEPS
    assert ours.generators == theirs.generators
    for kind in ("parameters", "exp_avg", "exp_avg_sq"):
        first, second = getattr(ours, kind), getattr(theirs, kind)
        assert all(torch.equal(first[name], second[name]) for name in second)
    assert {step: row for step, row in rows(out).items() if step in rows(whole)} == rows(whole)
    assert summary(out)["status"] == "finished" and summary(out)["error"] is None
    assert {path.name for path in out.iterdir()} == {path.name for path in whole.iterdir()}


class Broken:
    """An operator's wrapper that raises in one step."""

    def __init__(self, error):
        self._error = error

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        answer = yield
        if context.step == FAILS_IN:
            raise self._error
        return answer


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "case",
    [
        (ZeroDivisionError("by zero"), "ZeroDivisionError: by zero (test_endings.py, line "),
        (MemoryError(), "out of memory (MemoryError); try --max-gaussians"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out of memory (RuntimeError"),
        (SystemExit("enough"), "SystemExit: enough"),
    ],
)
def test_an_unexpected_error_keeps_all_results(scene, whole, tmp_path, with_plugin, capsys, case):
    error, words = case
    out = tmp_path / "run"
    with_plugin["broken"] = Broken(error)
    assert run(scene, out) == 1
    told = capsys.readouterr().err
    hook = "in hook crossgrad_aggregate_gradients of plugin broken, "
    assert told.startswith(f"training failed: in step {FAILS_IN}: {hook}") and words in told
    assert "Traceback" not in told and f"{out / 'log.txt'} contains the traceback" in told
    assert told.rstrip().endswith(f"continue with: crossgrad run --resume {out}")
    log = (out / "log.txt").read_text()
    assert "Traceback (most recent call last)" in log and type(error).__name__ in log
    found = summary(out)
    assert (found["status"], found["step"]) == ("failed", FAILS_IN - 1)
    assert words in found["error"] and found["overall"]["psnr"] > 5
    assert {path.name for path in out.iterdir()} >= RESULTS
    with_plugin.clear()
    assert resumed(out) == 0
    assert_same(out, whole)


def test_a_photo_that_cannot_be_read_at_an_evaluation_keeps_the_run(
    scene, whole, tmp_path, monkeypatch, capsys
):
    def unreadable(*args, **kwargs):
        raise UserError("the photo cannot be decoded", where="0003.png", todo="copy it again")

    out = tmp_path / "run"
    with monkeypatch.context() as rot:
        rot.setattr(session, "evaluate", unreadable)
        assert run(scene, out) == 1
    told = capsys.readouterr().err
    assert told.count("the photo cannot be decoded") == told.count("copy it again") == 1
    assert "traceback" not in told.lower()
    assert load(latest(out)).step == summary(out)["step"] == 4
    assert summary(out)["overall"] is None and (out / "point_cloud.ply").is_file()
    assert resumed(out) == 0
    assert_same(out, whole)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "case",
    [
        ("save", "checkpoints"), ("write_per_view", "per_view.csv"), ("draw_curve", "curve.png"),
        ("export_scene", "point_cloud.ply"), ("write_summary", "summary.json"),
    ],
)  # fmt: skip
def test_one_failing_result_at_the_end_of_a_run_does_not_prevent_other_results(
    scene, whole, tmp_path, monkeypatch, capsys, case
):
    function, missing = case

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    out = tmp_path / "run"
    with monkeypatch.context() as disk:
        disk.setattr(session, function, full)
        assert run(scene, out) == 1
    told = capsys.readouterr().err
    assert "No space left on device" in told and "continue with" in told
    names = {path.name for path in out.iterdir()}
    assert {"config.yaml", "metrics.csv", "log.txt", *RESULTS, "checkpoints"} - names == {missing}
    if missing != "summary.json":
        assert summary(out)["status"] == "failed"
        assert "No space left on device" in summary(out)["error"]
    if missing != "checkpoints":
        assert resumed(out) == 0
        assert_same(out, whole)


class Unkind:
    """Raises when the run starts or ends."""

    def __init__(self, when):
        self._when = when

    @hookimpl
    def crossgrad_run_start(self, run):
        if self._when == "start":
            raise ValueError("no start")

    @hookimpl
    def crossgrad_run_end(self, status):
        if self._when == "end":
            raise ValueError("no end")


def test_an_observer_that_raises_when_the_run_ends_loses_no_results(
    scene, tmp_path, with_plugin, capsys
):
    with_plugin["unkind"] = Unkind("end")
    assert run(scene, tmp_path / "run") == 1
    assert "ValueError: no end" in capsys.readouterr().err
    found = summary(tmp_path / "run")
    assert found["status"] == "failed" and "no end" in found["error"]
    assert found["step"] == STEPS and found["overall"]["psnr"] > 5


def test_an_observer_that_raises_when_the_run_starts_fails_the_run(
    scene, tmp_path, with_plugin, capsys
):
    with_plugin["unkind"] = Unkind("start")
    assert run(scene, tmp_path / "run") == 1
    assert "ValueError: no start" in capsys.readouterr().err
    found = summary(tmp_path / "run")
    assert (found["status"], found["step"], found["overall"]) == ("failed", 0, None)
    assert found["exports"] == {}


class Signals:
    """Sends this process signals after a step, or in the evaluation after it."""

    def __init__(self, step, *numbers, evaluation=False):
        self._step, self._numbers, self._evaluation = step, numbers, evaluation

    def _send(self, step):
        if step == self._step:
            for number in self._numbers:
                os.kill(os.getpid(), number)

    @hookimpl
    def crossgrad_step_end(self, record):
        if not self._evaluation:
            self._send(record.step)

    @hookimpl
    def crossgrad_evaluation(self, report):
        if self._evaluation:
            self._send(report.step)


@pytest.fixture
def hangup():
    """SIGHUP as a terminal sends it, where what started the tests ignores it, as nohup does."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.sampled(1)
@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_run_after_its_step(scene, whole, tmp_path, with_plugin, capsys, number):
    out = tmp_path / "run"
    with_plugin["signals"] = Signals(3, number)
    assert run(scene, out) == 128 + number
    assert capsys.readouterr().err.endswith(f"continue with: crossgrad run --resume {out}\n")
    assert (summary(out)["status"], summary(out)["step"]) == ("stopped", 3)
    assert summary(out)["overall"]["psnr"] > 5
    with_plugin.clear()
    assert resumed(out) == 0
    assert_same(out, whole)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("evaluation", [False, True])
def test_a_second_signal_skips_evaluation_but_saves_a_checkpoint(
    scene, whole, tmp_path, with_plugin, capsys, evaluation
):
    out = tmp_path / "run"
    with_plugin["signals"] = Signals(4, signal.SIGINT, signal.SIGTERM, evaluation=evaluation)
    assert run(scene, out) == 130
    assert capsys.readouterr().err.endswith(f"continue with: crossgrad run --resume {out}\n")
    found = summary(out)
    assert (found["status"], found["step"]) == ("stopped", 4)
    assert load(latest(out)).step == 4
    assert found["exports"] == {} and not (out / "point_cloud.ply").exists()
    with_plugin.clear()
    assert resumed(out) == 0
    assert_same(out, whole)


def test_a_second_signal_stops_the_evaluation_of_a_finished_run(
    scene, whole, tmp_path, with_plugin
):
    out = tmp_path / "run"
    with_plugin["signals"] = Signals(STEPS, signal.SIGINT, signal.SIGINT, evaluation=True)
    assert run(scene, out) == 130
    assert (summary(out)["status"], summary(out)["step"]) == ("stopped", STEPS)
    with_plugin.clear()
    assert resumed(out) == 0
    assert_same(out, whole)


def test_signals_that_the_process_ignores_are_still_ignored(scene, tmp_path, with_plugin):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with_plugin["signals"] = Signals(3, signal.SIGHUP)
        assert run(scene, tmp_path / "run") == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_run_that_was_killed_at_its_very_end_is_completed(scene, whole, tmp_path):
    out = tmp_path / "run"
    assert run(scene, out) == 0
    for name in ("summary.json", "per_view.csv", "point_cloud.ply"):
        (out / name).unlink()
    assert resumed(out) == 0
    assert_same(out, whole)
    with pytest.raises(UserError, match="the run is finished"):
        resumed(out)


def rotten(path):
    """Spoils the pixels of a photo; header and end stay, so that reading finds nothing."""
    content = bytearray(path.read_bytes())
    start, end = content.index(b"IDAT") + 4, content.rindex(b"IEND") - 8
    content[start:end] = bytes(end - start)
    path.write_bytes(content)


def test_a_held_out_photo_that_cannot_be_decoded_is_refused_before_training(tmp_path):
    scene = write_tiny_scene(tmp_path / "tiny", views=9)
    rotten(scene / "images" / "0008.png")
    with pytest.raises(UserError, match=r"cannot be decoded(.|\n)*0008\.png"):
        run(scene, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("dry", [False, True])
def test_check_option_also_decodes_training_photos_before_anything_is_written(tmp_path, dry):
    scene = write_tiny_scene(tmp_path / "tiny", views=9)
    rotten(scene / "images" / "0003.png")
    rotten(scene / "images" / "0005.png")
    settings = {"scene": str(scene), "steps": 2, "out": str(tmp_path / "run")}
    with pytest.raises(UserError, match=r"2 photos cannot be decoded(.|\n)*0003\.png.*0005\.png"):
        app.run(settings, check=True, dry_run=dry, verbosity=-1)
    assert not (tmp_path / "run").exists()


class Waiting:
    """Holds up the first step until the run was asked to stop, and the photos until that step."""

    def __init__(self, monkeypatch):
        self.reached = threading.Event()
        monkeypatch.setattr(photos_ahead, "_give_way", lambda: self.reached.wait(30))

    @hookimpl
    def crossgrad_step_end(self, record):
        self.reached.set()
        for thread in threading.enumerate():
            if thread.name == "crossgrad-photos":
                thread.join(30)


def test_a_training_photo_that_cannot_be_decoded_is_found_during_training(
    tmp_path, with_plugin, capsys, monkeypatch
):
    """No step renders the damaged photo, because the sampler uses the first views only."""
    scene = write_tiny_scene(tmp_path / "tiny", views=9)
    (scene / "train_list.txt").write_text("\n".join(f"{i:04}.png" for i in range(1, 8)))
    rotten(scene / "images" / "0007.png")
    with_plugin["waiting"] = Waiting(monkeypatch)
    with_plugin["first"] = FirstViews()
    monkeypatch.setattr(app, "warm_up", lambda *args: 0.0)
    assert run(scene, tmp_path / "run") == 1
    told = capsys.readouterr().err
    assert "0007.png" in told and "training failed: the photo cannot be decoded" in told
    assert load(latest(tmp_path / "run")).step == summary(tmp_path / "run")["step"] == 1


class FirstViews:
    """Draws the first two views in every step."""

    @hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        sampled = yield
        return replace(sampled, draw=replace(sampled.draw, views=(0, 1)))


class Leaves:
    """Puts the first three primitives behind a camera, and opaque, in every step."""

    @hookimpl
    def crossgrad_after_step(self, context):
        camera = context.scene.train_views[0].camera
        backwards = -camera.world_to_camera[2, :3]
        centers = (camera.center + 0.02 * backwards).float().repeat(3, 1)
        rows = torch.arange(3)
        sizes, opaque = torch.full((3, 3), -6.0), torch.full((3,), 5.0)
        values = {"means": centers, "scales": sizes, "opacities": opaque}
        return DensifyResult(Edit(values={name: Rows(each, rows) for name, each in values.items()}))


@pytest.mark.slow
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ZeroDivisionError("by zero")])
def test_an_error_in_the_removal_of_floaters_loses_no_results(
    scene, tmp_path, with_plugin, monkeypatch, error
):
    with_plugin["leaves"] = Leaves()
    whole, out = tmp_path / "whole", tmp_path / "run"
    assert run(scene, whole) == 0

    @hookimpl
    def broken(self, model):
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(Floaters, "crossgrad_final_edit", broken)
        assert run(scene, out) == (0 if isinstance(error, KeyboardInterrupt) else 1)
    stopped = isinstance(error, KeyboardInterrupt)
    assert summary(out)["status"] == ("stopped" if stopped else "failed")
    if not stopped:
        told = "the trained model was not changed: in hook crossgrad_final_edit of rule floaters"
        assert summary(out)["error"].startswith(told)
        assert "ZeroDivisionError: by zero" in summary(out)["error"]
    assert read_metrics(out)[-1]["primitives"] == summary(whole)["primitives"] + 3
    assert resumed(out) == 0
    assert_same(out, whole)
    assert read_metrics(out)[-1]["primitives"] == summary(whole)["primitives"]
    assert len(read_ply(out / "point_cloud.ply").means) == summary(whole)["primitives"]


def test_floaters_are_removed_when_a_run_is_finished(scene, tmp_path, with_plugin):
    with_plugin["leaves"] = Leaves()
    cleaned, stopped, kept = tmp_path / "cleaned", tmp_path / "stopped", tmp_path / "kept"
    assert run(scene, cleaned) == 0
    assert run(scene, stopped, stop_after=3) == 0
    assert run(scene, kept, rules={"floaters": False}) == 0
    count = summary(kept)["primitives"]
    assert summary(stopped)["primitives"] == count
    assert summary(cleaned)["primitives"] == count - 3
    for out, primitives in ((cleaned, count - 3), (kept, count)):
        assert len(read_ply(out / "point_cloud.ply").means) == primitives
        assert read_metrics(out)[-1]["primitives"] == primitives
    said = "floaters: 3 primitives were removed from the empty space"
    assert said in (cleaned / "log.txt").read_text()
    assert not any("floaters: 3" in (each / "log.txt").read_text() for each in (stopped, kept))
    assert resumed(stopped) == 0
    assert_same(stopped, cleaned)
