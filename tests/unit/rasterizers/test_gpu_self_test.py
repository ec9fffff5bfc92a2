"""A rasterizer that draws wrongly on a machine is refused before the first step."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from support import gsplat_on_cpu

from crossgrad_core.contract.gaussians import Render
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.start import warm_up
from crossgrad_plugins.rasterizers.gpu.self_test import self_test
from crossgrad_plugins.rasterizers.gsplat_cuda import GsplatRasterizer
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer


class Changed(TorchRasterizer):
    """The reference with something done to its images."""

    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, image=self.changed(render.image))

    def changed(self, image):
        return image


class Dark(Changed):
    def changed(self, image):
        return 0.9 * image


class Unwritten(Changed):
    def changed(self, image):
        return torch.where(torch.arange(len(image))[:, None, None] == 3, torch.nan, image)


class HalfGradients(Changed):
    def changed(self, image):
        return 0.5 * image + 0.5 * image.detach()


class NoGradients(Changed):
    def changed(self, image):
        return image + 0.0 * image.sum().detach()

    def render(self, gaussians, camera, background, outputs=frozenset()):
        detached = gaussians.detached()
        means = gaussians.means
        render = super().render(replace(detached, means=means), camera, background, outputs)
        assert isinstance(render, Render)
        return render


class Broken(Changed):
    def changed(self, image):
        raise RuntimeError("Ninja is required to load C++ extensions")


class WrongFirst(Changed):
    calls: ClassVar[list[int]] = []

    def changed(self, image):
        self.calls.append(1)
        return 0.9 * image if len(self.calls) == 1 else image


@pytest.mark.parametrize("rasterizer", [TorchRasterizer(), NumbaRasterizer()])
@pytest.mark.parametrize("footprint", ["alpha", "3-sigma"])
def test_bundled_rasterizers_pass_the_self_test(rasterizer, footprint):
    self_test(rasterizer.model_copy(update={"footprint": footprint}), "cpu")


def test_gsplat_passes_the_self_test_with_its_torch_reference(monkeypatch):
    pytest.importorskip("gsplat")
    gsplat_on_cpu.install(monkeypatch)
    GsplatRasterizer().self_test("cpu")


@pytest.mark.parametrize(
    ("rasterizer", "found"),
    [
        (Dark(), "pixels differ by up to"),
        (Unwritten(), "pixels differ by up to nan"),
        (HalfGradients(), "the gradient of the means differs by 0.5"),
        (NoGradients(), "the gradient of the quats differs by 1 "),
        (Broken(), "RuntimeError: Ninja is required"),
        (WrongFirst(), "pixels differ by up to"),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_wrong_rasterizer_fails_the_self_test_with_a_remedy(rasterizer, found):
    with pytest.raises(UserError) as raised:
        self_test(rasterizer, "cpu")
    assert found in raised.value.found
    assert "torch's CUDA version" in raised.value.todo


def test_the_self_test_runs_before_training(monkeypatch):
    asked = []
    monkeypatch.setattr(NumbaRasterizer, "self_test", lambda _self, device: asked.append(device))
    from crossgrad_core.config import RunConfig

    warm_up(assemble(RunConfig(steps=2), sample_scene(), "none"))
    assert asked == ["cpu"]
