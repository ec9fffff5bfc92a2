"""Runs from Python have the bits of the command line, in whatever process they take place."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
import torch
from support.same_bits import bits
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.cli.main import main
from crossgrad_core.run.results.lock import locked
from crossgrad_core.run.session import Session

OPTIONS = {
    "sampler": "near-far", "operator": "pcgrad", "steps": 12, "eval_every": 6, "seed": 3,
    "operator.granularity": "global", "densify_from": 3, "densify_until": 11, "densify_every": 3,
    "schedule_unit": "steps",
}  # fmt: skip
#: Steps after which the run is evaluated; one that is stopped is evaluated there, too.
EVALUATED = {"6", "12"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=9)


@pytest.fixture(scope="module")
def reference(scene, tmp_path_factory):
    """The folder of the same run from the command line."""
    out = tmp_path_factory.mktemp("reference") / "run"
    command(scene, out, *(f"--set={key}={value}" for key, value in OPTIONS.items()))
    return out


def command(scene, out, *arguments):
    line = [sys.executable, "-m", "crossgrad_core", "run", str(scene), "--out", str(out)]
    subprocess.run([*line, "--quiet", *arguments], check=True, timeout=290, capture_output=True)


def run(scene, out, **options):
    return cg.run(scene, out=out, quiet=True, **{**OPTIONS, **options})


@pytest.mark.slow
def test_two_runs_in_one_process_have_the_bits_of_the_command(scene, reference, tmp_path):
    first = run(scene, tmp_path / "first")
    run(scene, tmp_path / "other", backbone="mip", operator="sum", threads=1, steps=3,
        **{"operator.granularity": None})  # fmt: skip
    second = run(scene, tmp_path / "second")
    assert bits(first.folder) == bits(reference) == bits(second.folder)


def test_a_run_in_a_thread_has_the_bits_of_the_command(scene, reference, tmp_path):
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    done = []
    thread = Thread(target=lambda: done.append(run(scene, tmp_path / "run")))
    thread.start()
    while thread.is_alive():
        assert all(signal.getsignal(number) == handler for number, handler in handlers.items())
        thread.join(0.01)
    assert bits(done[0].folder) == bits(reference)
    image = done[0].render(done[0].scene.test_views[0].name)
    rendered = []
    thread = Thread(
        target=lambda: rendered.append(done[0].render(done[0].scene.test_views[0].name))
    )
    thread.start()
    thread.join()
    assert np.array_equal(rendered[0], image)


@pytest.fixture
def disturbed():
    """A process in which the user has set what a run must not depend on."""
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.set_num_threads(1)
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002 - the global generator is what is meant
    with torch.inference_mode(), np.errstate(all="raise"):
        yield
        assert torch.get_default_dtype() == torch.float64
        assert torch.get_default_device() == torch.device("meta")
        assert torch.get_num_threads() == 1
        assert torch.is_inference_mode_enabled()
    torch.set_default_dtype(torch.float32)
    torch.set_default_device("cpu")
    torch.set_num_threads(threads)


def test_a_run_does_not_depend_on_settings_of_its_process(disturbed, scene, reference, tmp_path):
    trained = run(scene, tmp_path / "run")
    assert bits(trained.folder) == bits(reference)
    assert trained.evaluate().overall["psnr"] == trained.metrics["psnr"][-1]
    assert trained.render(trained.scene.test_views[0].camera).max() > 0.1


def test_a_stopped_run_resumed_from_python_has_the_bits_of_the_command(scene, reference, tmp_path):
    stopped = run(scene, tmp_path / "run", stop_after=5)
    assert stopped.summary["status"] == "stopped"
    finished = cg.resume(stopped.folder, quiet=True)
    assert finished.summary["status"] == "finished"
    assert bits(finished.folder, EVALUATED) == bits(reference)
    with pytest.raises(cg.UserError, match="the run is finished"):
        cg.resume(stopped.folder, quiet=True)
    with pytest.raises(cg.UserError, match="settings cannot be changed"):
        cg.resume(stopped.folder, quiet=True, seed=4)


def test_an_interrupt_stops_after_the_step_and_the_run_can_be_resumed(
    scene, reference, tmp_path, monkeypatch
):
    save = Session.save

    def interrupted(self, setup, state):
        save(self, setup, state)
        if state.step == 4:
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(Session, "save", interrupted)
    with pytest.raises(KeyboardInterrupt, match="stopped"):
        run(scene, tmp_path / "run", save_every=4)
    assert signal.getsignal(signal.SIGINT) is before
    stopped = cg.open(tmp_path / "run")
    assert stopped.summary["status"] == "stopped" and 4 <= stopped.summary["step"] < 12
    monkeypatch.undo()
    resumed = cg.resume(stopped.folder, quiet=True)
    assert bits(resumed.folder, EVALUATED) == bits(reference)


def test_a_run_that_receives_sigterm_saves_and_ends_the_process(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Session, "save", lambda *_: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(SystemExit) as ended:
        run(scene, tmp_path / "run", save_every=4)
    assert ended.value.code == 128 + signal.SIGTERM


def test_a_failed_run_raises_an_error_with_its_folder_and_cause(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Session, "evaluate", lambda *_, **__: 1 / 0)
    with pytest.raises(cg.RunFailedError, match="ZeroDivisionError") as failed:
        run(scene, tmp_path / "run")
    assert isinstance(failed.value.__cause__, ZeroDivisionError)
    assert cg.open(failed.value.folder).summary["status"] == "failed"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"operatr": "sum"}, "did you mean 'operator'"),
        ({"steps": 0}, "greater than or equal to 1"),
        ({"operator": "sun"}, "did you mean 'sum'"),
        ({"operator": {"name": "cagrad", "d": 1}}, "cagrad has no option"),
        (
            {"steps": 3, "seconds": 3},
            "a run has a length in steps, in views or in seconds, or in views",
        ),
    ],
)
def test_an_invalid_option_gives_the_error_of_the_command(scene, tmp_path, options, words, capfd):
    with pytest.raises(cg.UserError, match=words) as raised:
        cg.run(scene, out=tmp_path / "run", quiet=True, **options)
    assert not (tmp_path / "run").exists()
    given = [f"--set={key}={json.dumps(value)}" for key, value in options.items()]
    with pytest.raises(SystemExit):
        main(["run", str(scene), "--out", str(tmp_path / "run"), "--quiet", *given])
    assert f"error: {raised.value}" in capfd.readouterr().err


def test_options_are_not_changed_and_may_be_numpy_numbers(scene, tmp_path):
    backbone = {"name": "vanilla"}
    given = {"backbone": backbone, "backbone.sh_degree": np.int32(1), "max_size": 40}
    trained = run(scene, tmp_path / "run", steps=np.int64(2), **given)
    assert backbone == {"name": "vanilla"}
    config = trained.summary["config"]
    assert config["backbone"]["sh_degree"] == 1 and config["steps"] == 2
    assert config["data"]["max_size"] == 40


def test_an_opened_run_returns_metrics_summary_and_renders(reference, tmp_path, capfd):
    opened = cg.open(reference)
    metrics = opened.metrics
    assert metrics["step"].tolist() == [6, 12] and metrics["step"].dtype == np.int64
    assert metrics["train_seconds"].dtype == np.float64 and np.isnan(metrics["lpips"]).all()
    assert {"psnr", "ssim", "psnr_far", "ssim_far", "primitives"} <= metrics.keys()
    assert opened.summary["overall"]["psnr"] == metrics["psnr"][-1]
    view = opened.scene.test_views[0]
    image = opened.render(view.name)
    assert image.shape == (view.camera.height, view.camera.width, 3)
    assert image.dtype == np.float32 and 0 <= image.min() < image.max() <= 1
    assert np.array_equal(opened.render(view.camera), image)
    photo = view.photo.image().numpy() / 255
    rounded = np.rint(image * 255) / 255
    psnr = -10 * np.log10(((rounded - photo) ** 2).mean())
    result = opened.evaluate()
    assert result.views[0]["psnr"] == pytest.approx(psnr, abs=1e-4)
    assert opened.export(tmp_path / "x.ply").read_bytes() == bits(reference)["ply"]
    assert capfd.readouterr().out == ""
    with pytest.raises(cg.UserError, match="no view 'nobody'"):
        opened.render("nobody")
    with pytest.raises(cg.UserError, match="not the folder of a run"):
        cg.open(tmp_path)


@pytest.mark.slow
def test_an_opened_run_is_read_again_after_it_was_resumed(scene, tmp_path):
    stopped = run(scene, tmp_path / "run", stop_after=5)
    name = stopped.scene.test_views[0].name
    before = stopped.render(name)
    cg.resume(stopped.folder, quiet=True)
    assert not np.array_equal(stopped.render(name), before)


def test_two_threads_cannot_write_into_one_run_folder(scene, tmp_path):
    stopped = run(scene, tmp_path / "run", stop_after=5)
    with (
        locked(stopped.folder, "training"),
        pytest.raises(cg.UserError, match="is writing to this folder"),
    ):
        cg.resume(stopped.folder, quiet=True)


def test_importing_the_core_imports_no_heavy_library():
    program = (
        "import sys, crossgrad_core as cg; cg.UserError; dir(cg)\n"
        "heavy = {'torch', 'numba', 'numpy', 'pydantic', 'typer', 'yaml'} & sys.modules.keys()\n"
        "assert not heavy, heavy\n"
        "import crossgrad_core.run.checkpoint\n"
        "assert callable(cg.run) and callable(cg.open) and callable(cg.resume)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "changed",
    [
        {"fx": 0.0}, {"fx": float("nan")}, {"fy": -80.0}, {"width": 0}, {"width": 50.5},
        {"cx": float("inf")}, {"world_to_camera": np.eye(4)},
        {"world_to_camera": 2.0 * torch.eye(4, dtype=torch.float64)},
        {"world_to_camera": torch.full((4, 4), float("nan"))},
    ],
    ids=str,
)  # fmt: skip
def test_rendering_an_invalid_camera_is_refused(reference, changed):
    run = cg.open(reference)
    camera = run.scene.test_views[0].camera
    assert run.render(camera).shape == (camera.height, camera.width, 3)
    sides = {"width": np.int64(camera.width), "height": np.int64(camera.height)}
    same = replace(camera, **sides, fx=np.float64(camera.fx))
    np.testing.assert_array_equal(run.render(same), run.render(camera))
    with pytest.raises(cg.UserError) as error:
        run.render(replace(camera, **changed))
    assert error.value.where == "Run.render"


@pytest.mark.parametrize("view", [5, None, "nobody"])
def test_rendering_an_unknown_view_is_refused(reference, view):
    with pytest.raises(cg.UserError) as error:
        cg.open(reference).render(view)
    assert error.value.where == "Run.render"
