"""Missing requirements of a third-party rasterizer are reported before training with a remedy."""

import sys
from types import SimpleNamespace

import pytest
import torch
from support.distributions import write_distribution
from support.selections import selection_of

from crossgrad_core.contract.objections import objections_to
from crossgrad_core.registry.entries import build
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer
from crossgrad_plugins.rasterizers.gpu import missing
from crossgrad_plugins.rasterizers.gsplat_cuda import GsplatRasterizer
from crossgrad_plugins.rasterizers.gswarp_cuda import GswarpRasterizer

CUDA = Wanted("cuda", "plain")


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A machine with these packages, a torch for this CUDA, and an nvcc that says its version."""

    def of(*packages, cuda="12.8", nvcc=None):
        places = SimpleNamespace(submodule_search_locations=[str(tmp_path / "package")])
        monkeypatch.setattr(missing, "find_spec", dict.fromkeys(packages, places).get)
        monkeypatch.setattr(torch.version, "cuda", cuda)
        for name in ("CUDA_HOME", "CUDA_PATH"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(missing.shutil, "which", lambda name: f"/usr/bin/{name}")
        compiler = tmp_path / "bin" / "nvcc"
        if nvcc is None:
            monkeypatch.setattr(missing, "find_nvcc", lambda: None)
        else:
            compiler.parent.mkdir()
            compiler.write_text(f"#!/bin/sh\necho 'Cuda compilation tools, release {nvcc}, V1'\n")
            compiler.chmod(0o755)
            monkeypatch.setenv("CUDA_HOME", str(tmp_path))

    return of


def objections(rasterizer, device="cuda", **more):
    selection = selection_of(rasterizer=rasterizer, device=device, **more)
    return rasterizer.crossgrad_validate_selection(selection)


def test_a_missing_package_is_named_with_its_extra(machine):
    machine()
    for rasterizer, package in ((GsplatRasterizer(), "gsplat"), (GswarpRasterizer(), "gswarp")):
        (reason,) = objections(rasterizer)
        assert f"pip install 'crossgrad[{package}]'" in reason


def test_gswarp_without_warp_is_not_available(machine):
    machine("gswarp")
    (reason,) = objections(GswarpRasterizer())
    assert "needs the package warp, which is not installed: pip install 'crossgrad[gs" in reason
    assert choose_rasterizer("auto", CUDA)[0] == "torch"


@pytest.mark.parametrize(
    ("nvcc", "reason"),
    [
        (None, "nvcc was not found: install the CUDA toolkit 12.8"),
        ("13.0", "belongs to CUDA 13.0, but torch"),
        ("12.4", None),
    ],
)
def test_gsplat_needs_a_compiler_for_the_cuda_version_of_torch(machine, nvcc, reason):
    machine("gsplat", nvcc=nvcc)
    found = objections(GsplatRasterizer())
    assert (found == []) == (reason is None)
    assert reason is None or reason in found[0]


def test_gsplat_with_compiled_kernels_needs_no_compiler(machine, tmp_path):
    machine("gsplat")
    assert objections(GsplatRasterizer())
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "csrc.cpython-311-x86_64-linux-gnu.so").touch()
    assert objections(GsplatRasterizer()) == []


def test_gsplat_needs_a_host_compiler(machine, monkeypatch):
    machine("gsplat", nvcc="12.8")
    monkeypatch.setattr(missing.shutil, "which", lambda _name: None)
    assert "no C++ compiler" in objections(GsplatRasterizer())[0]


def test_gsplat_needs_ninja_on_the_path_or_next_to_python(machine, monkeypatch, tmp_path):
    machine("gsplat", nvcc="12.8")
    monkeypatch.setattr(missing.shutil, "which", lambda name: None if name == "ninja" else name)
    monkeypatch.setattr(missing.sys, "executable", str(tmp_path / "env" / "python"))
    monkeypatch.setenv("PATH", "/usr/bin")
    assert "ninja was not found: pip install ninja" in objections(GsplatRasterizer())[0]
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "ninja").touch()
    assert objections(GsplatRasterizer()) == []
    missing.bring_ninja.__wrapped__()
    assert missing.os.environ["PATH"] == f"/usr/bin{missing.os.pathsep}{tmp_path / 'env'}"


def test_nvcc_is_searched_only_in_cuda_home_if_set(monkeypatch, tmp_path):
    monkeypatch.setattr(missing.shutil, "which", lambda name: str(tmp_path / name))
    (tmp_path / "nvcc").touch()
    for name in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    assert missing.find_nvcc() == tmp_path / "nvcc"
    monkeypatch.setenv("CUDA_PATH", str(tmp_path / "gone"))
    assert missing.find_nvcc() is None
    monkeypatch.setattr(missing, "find_spec", lambda _name: None)
    assert (
        f"nvcc was not found in {tmp_path / 'gone'}, where CUDA_HOME"
        in missing.compiler_missing("gsplat")
    )


def test_an_nvcc_without_a_readable_version_is_accepted(machine, tmp_path):
    machine("gsplat", nvcc="12.8")
    (tmp_path / "bin" / "nvcc").write_text("#!/bin/sh\nexit 1\n")
    missing.nvcc_version.cache_clear()
    assert objections(GsplatRasterizer()) == []


def test_an_unsupported_device_is_the_only_objection_on_a_cpu(machine):
    machine()
    for name, rasterizer in (("gsplat", GsplatRasterizer()), ("gswarp", GswarpRasterizer())):
        assert objections(rasterizer, device="cpu") == []
        selection = selection_of(rasterizer=rasterizer, names={"rasterizer": name})
        assert objections_to(selection) == [f"rasterizer {name} does not run on device cpu"]


@pytest.mark.parametrize(
    ("slot", "name", "rasterizer", "reason"),
    [
        ("densifier", "pixel", "gswarp", "needs the screen statistics pixels"),
        ("densifier", "dc4gs", "gsplat", "needs the screen statistics directions"),
        ("densifier", "multiview", "gswarp", "needs the screen statistics abs_gradient, count"),
        ("densifier", "absgrad", "gswarp", "needs the screen statistics abs_gradient"),
        ("backbone", "analytic", "gsplat", "does not support the pixel response analytic"),
        ("backbone", "mip", "gswarp", "does not support the pixel response antialiased"),
    ],
)
def test_outputs_that_a_rasterizer_lacks_are_refused_before_training(
    slot, name, rasterizer, reason
):
    chosen = {slot: build(f"{slot}s", name, {}), "rasterizer": build("rasterizers", rasterizer, {})}
    selection = selection_of(device="cuda", names={slot: name, "rasterizer": rasterizer}, **chosen)
    assert any(reason in objection for objection in objections_to(selection))


def test_gswarp_refuses_a_backbone_that_sets_a_dilation(machine):
    machine("gswarp", "warp")

    class Own(type(build("backbones", "vanilla", {}))):
        sets_dilation = True

    assert "sets its own dilation" in objections(GswarpRasterizer(), backbone=Own())[0]


def test_the_fastest_installed_rasterizer_with_the_needed_outputs_is_chosen(machine):
    machine("gsplat", "gswarp", "warp", nvcc="12.8")
    assert choose_rasterizer("auto", CUDA)[0] == "gsplat"
    assert choose_rasterizer("auto", Wanted("cuda", "plain", frozenset({"count"})))[0] == "gsplat"
    chosen, notes = choose_rasterizer("auto", Wanted("cuda", "plain", frozenset({"directions"})))
    assert chosen == "torch"
    assert "rasterizer gsplat is not used: this run needs directions" in notes
    inria = Wanted("cuda", "plain", options=frozenset({"footprint"}))
    assert choose_rasterizer("auto", inria)[0] == "gswarp"
    assert choose_rasterizer("auto", Wanted("cuda", "antialiased"))[0] == "gsplat"
    assert choose_rasterizer("auto", Wanted("cpu", "plain"))[0] == "numba"


def test_gswarp_is_chosen_without_a_compiler_and_the_reference_without_gswarp(machine):
    machine("gsplat", "gswarp", "warp")
    assert choose_rasterizer("auto", CUDA)[0] == "gswarp"
    machine()
    assert choose_rasterizer("auto", CUDA)[0] == "torch"


def test_a_third_party_rasterizer_takes_part_in_the_choice(machine, tmp_path, monkeypatch):
    machine("gsplat", nvcc="12.8")
    source = """
from crossgrad_core.plugin import Rasterizer

class Faster(Rasterizer):
    devices = frozenset({"cuda"})

    @classmethod
    def speed(cls, device):
        return 200.0 if device == "cuda" else 0.0

    def render(self, gaussians, camera, background, outputs=frozenset()):
        raise NotImplementedError
"""
    entry = {"faster": "made_up_gpu:Faster"}
    write_distribution(tmp_path, "made-up-gpu", {"rasterizers": entry}, {"made_up_gpu": source})
    monkeypatch.syspath_prepend(tmp_path)
    assert choose_rasterizer("auto", CUDA)[0] == "faster"
    assert choose_rasterizer("auto", Wanted("cpu", "plain"))[0] == "numba"
    sys.modules.pop("made_up_gpu", None)
