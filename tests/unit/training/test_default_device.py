"""`--device auto`: a GPU if a rasterizer for it is installed and works, else the CPU and why."""

import logging
from types import SimpleNamespace

import pytest
import torch

from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.devices import with_device
from crossgrad_core.run.load_run import _config
from crossgrad_core.run.settings import parsed
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.rasterizers.gpu import missing
from crossgrad_plugins.rasterizers.gswarp_cuda import GswarpRasterizer

GPU = "NVIDIA Test"
WORKS = ("gswarp", "warp")


def device_of(**settings):
    config, notes = with_device(parsed(settings))
    return config.device, notes


@pytest.fixture
def on_a_gpu(monkeypatch):
    """A machine with a GPU and these packages; gswarp's trial raises what `tried` holds."""
    tried = SimpleNamespace(error=None, devices=[])

    def self_test(_rasterizer, device):
        tried.devices.append(device)
        if tried.error is not None:
            raise tried.error

    def of(*packages):
        monkeypatch.setattr(missing, "find_spec", dict.fromkeys(packages, SimpleNamespace()).get)
        return tried

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: GPU)
    monkeypatch.setattr(GswarpRasterizer, "self_test", self_test)
    return of


@pytest.fixture
def without_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.usefixtures("without_a_gpu")
def test_a_machine_without_a_gpu_uses_the_cpu_without_a_note():
    assert device_of() == ("cpu", ())


@pytest.mark.usefixtures("without_a_gpu")
def test_the_selected_device_is_recorded_in_the_configuration():
    assert parsed({}).device == "auto"
    assert assemble(parsed({"steps": 9}), sample_scene(), "none").config.device == "cpu"


def test_a_gpu_is_selected_if_a_rasterizer_works_and_the_trial_runs_once(on_a_gpu, caplog):
    tried = on_a_gpu(*WORKS)
    with caplog.at_level(logging.INFO, "crossgrad_core"):
        device, notes = device_of()
    assert device == "cuda"
    assert notes == (
        f"device cuda: rasterizer gswarp works on {GPU} (use --device cpu to avoid the GPU)",
    )
    assert tried.devices == ["cuda"]
    assert "testing rasterizer gswarp on the GPU" in caplog.text


def test_a_gpu_without_a_rasterizer_gives_one_line_with_the_package_to_install(on_a_gpu):
    on_a_gpu()
    device, (note,) = device_of()
    assert device == "cpu"
    assert note.startswith(f"device cpu: {GPU} is not used, because rasterizer gsplat needs")
    for package in ("gsplat", "gswarp"):
        assert f"pip install 'crossgrad[{package}]'" in note
    assert "\n" not in note


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (UserError("it draws wrongly", found="pixels are off"), "it draws wrongly; pixels are off"),
        (RuntimeError("no kernel\nimage"), "gswarp failed: RuntimeError: no kernel image"),
    ],
    ids=["wrong", "broken"],
)
def test_the_cpu_is_used_if_the_gpu_rasterizer_does_not_work(on_a_gpu, error, why):
    on_a_gpu(*WORKS).error = error
    device, (note,) = device_of()
    assert device == "cpu"
    assert note.endswith(why)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"rasterizer": {"name": "numba"}}, "because rasterizer numba does not run on the GPU"),
        ({"rasterizer": {"name": "gsplat"}}, "pip install 'crossgrad[gsplat]'"),
        ({"seconds": 9.0, "clock": "cpu"}, "because --clock cpu does not count the time of a GPU"),
        (
            {"backbone": {"name": "analytic"}},
            "rasterizer gswarp is not used: this run needs analytic",
        ),
        ({"densifier": {"name": "absgrad"}}, "gswarp is not used: this run needs abs_gradient"),
    ],
    ids=str,
)
def test_runs_that_the_gpu_rasterizers_do_not_support_use_the_cpu(on_a_gpu, settings, why):
    tried = on_a_gpu(*WORKS)
    device, (note,) = device_of(**settings)
    assert device == "cpu"
    assert why in note
    assert not tried.devices


def test_the_reference_rasterizer_uses_a_gpu_only_if_named(on_a_gpu):
    on_a_gpu()
    assert device_of()[0] == "cpu"
    assert device_of(rasterizer={"name": "torch"})[0] == "cuda"


@pytest.mark.parametrize("name", ["cpu", "cuda:1"])
def test_a_named_device_is_used_without_a_trial(on_a_gpu, name):
    tried = on_a_gpu(*WORKS)
    assert device_of(device=name) == (name, ())
    assert not tried.devices


@pytest.mark.usefixtures("without_a_gpu")
def test_a_run_can_be_resumed_on_the_automatically_selected_device(tmp_path):
    (tmp_path / "config.yaml").write_text(
        "scene: s\nseed: 0\nsteps: 3\nrasterizer: {name: gsplat}\n"
    )
    config = _config(tmp_path, {"device": "auto"})
    assert config.device == "cpu"
    assert config.rasterizer.name == "auto"
