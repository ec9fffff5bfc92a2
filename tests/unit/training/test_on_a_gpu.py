"""A step on a GPU: what is read back from it, and views that are drawn together.

A device that notes what is read back from it stands for the GPU, and for its rasterizer one that
draws each Gaussian in each pixel.
"""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from typing import ClassVar

import pytest
import torch
from support import counted

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.gaussians import Render, Screen
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.scaled_photos import DevicePhotos, ScaledPhotos
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import NonFiniteError
from crossgrad_plugins.rasterizers.gpu.nested import Call, Drawing, drawn
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer
from crossgrad_plugins.rasterizers.reference.harmonics import view_colors
from crossgrad_plugins.rasterizers.reference.projection import project, shape

#: Set in the process that has the device: torch has to know it before the first backward pass.
FRESH = "CROSSGRAD_COUNTED_DEVICE"
needs_device = pytest.mark.skipif(FRESH not in os.environ, reason="run in a process of their own")


@pytest.mark.slow
@pytest.mark.skipif(counted.REGISTER is None, reason="this torch has no backends in Python")
def test_the_device_tests_of_this_file_pass_in_a_separate_process(request):
    """Run the tests of this file that need the device."""
    config = request.config
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider"]
    command += ["-c", str(config.inipath), "--rootdir", str(config.rootpath), __file__]
    ended = subprocess.run(
        [*command, "-k", "not own and not together_train"],
        env={**os.environ, FRESH: "1"},
        cwd=config.rootpath,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout
    assert "skipped" not in ended.stdout


class Dense(Rasterizer):
    """Each Gaussian in each pixel, front to back; reads nothing back."""

    devices: ClassVar[frozenset[str]] = frozenset({counted.NAME})
    responses = frozenset({"plain", "antialiased"})

    def render(self, gaussians, camera, background, outputs=frozenset()):
        screen = Screen(torch.ones_like(gaussians.opacities).int())
        call = Call(partial(blend, gaussians, camera, background), partial(note, screen))
        (image,) = drawn(call, gaussians.floats())
        return Render(image, image[..., 0], screen)


class Together(Dense):
    batched: ClassVar[bool] = True


def blend(gaussians, camera, background, tensors):
    given = iter(tensors)
    gaussians = gaussians.mapped(lambda _tensor: next(given))
    flat = project(gaussians.means, gaussians.quats, gaussians.scales, camera)
    shapes = shape(flat, gaussians.opacities, 0.3, gaussians.response)
    across = torch.arange(camera.width, device=flat.means.device) + 0.5
    down = torch.arange(camera.height, device=flat.means.device) + 0.5
    dx = (flat.means[:, 0] - across[:, None])[None]
    dy = (flat.means[:, 1] - down[:, None])[:, None]
    a, b, c = shapes.parameters.unbind(-1)
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    order = flat.depths.argsort()
    alpha = (shapes.opacities * power.clamp(max=0.0).exp()).clamp(max=0.99)[..., order]
    after = (1 - alpha).cumprod(-1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    colors = view_colors(gaussians, camera.center.to(gaussians.means, non_blocking=True))[order]
    return Drawing((((alpha * before) @ colors) + after[..., -1:] * background,), flat.means)


def note(screen, _centers, gradient):
    screen.mean_gradient = gradient


def on_gpu(rasterizer, **options):
    """A run on the counted device."""
    config = {"steps": 100, "metrics": [{"name": "psnr"}], **options}
    setup = assemble(RunConfig.model_validate(config), sample_scene(), "none")
    return moved(setup, rasterizer, counted.device())


def moved(setup, rasterizer, device):
    selection = replace(setup.selection, rasterizer=rasterizer, device=device.type)
    manager = make_manager(selection.components)
    photos = DevicePhotos(ScaledPhotos(64), device, 64)
    return replace(setup, selection=selection, manager=manager, device=device, scaled_photos=photos)


def steps(setup, count):
    """What is read back in each step, and the last record."""
    found = []
    with counted.Reads() as reads:
        state = first_state(setup)
        for _ in range(count):
            reads.found.clear()
            record = timed_step(setup, state)
            found.append(list(reads.found))
    return found, record


@needs_device
@pytest.mark.parametrize(
    ("rasterizer", "options"),
    [
        (Dense(), {"background": "random"}),
        (Together(), {"views": 3, "resolution": {"name": "octaves"}}),
        (Together(), {"views": 2, "operator": {"name": "pcgrad"}, "exposure": {"name": "gain"}}),
        (Dense(), {"views": 2, "backbone": {"name": "mip"}}),
        (Dense(), {"backbone": {"name": "distance"}}),
    ],
    ids=str,
)
def test_a_step_reads_back_from_the_device_twice_for_any_k(rasterizer, options):
    """A step reads the losses, and the Gramians or the check for finite gradients."""
    found, record = steps(on_gpu(rasterizer, **options), 3)
    assert found[1:] == [[READ, kind(options)]] * 2
    assert all(loss > 0.0 for loss in record.losses)


READ = "tolist"


def kind(options):
    """Gramians come back as a matrix, everything else as a list."""
    return "_to_copy to the CPU" if options.get("operator") == {"name": "pcgrad"} else READ


@needs_device
def test_the_test_device_records_each_value_that_is_read_back():
    with counted.Reads() as reads:
        one = torch.arange(3.0).to(counted.device(), non_blocking=True)
        two = torch.zeros(3, device=counted.device()).to(torch.float64)
        assert not reads.found
        for read in (
            lambda: torch.arange(3.0).to(one.device),
            lambda: torch.arange(3.0).to(two),
            lambda: one.new_tensor([1.0]),
            lambda: one.copy_(torch.arange(3.0)),
            lambda: one[torch.tensor([0, 2])],
            lambda: torch.tensor(1.0, device=one.device),
            lambda: float(one.sum()),
            lambda: bool((one > 0).any()),
            lambda: one[one > 0],
            one.cpu,
            one.tolist,
            one.nonzero,
        ):
            reads.found.clear()
            read()
            assert len(reads.found) == 1
    with pytest.raises((RuntimeError, TypeError)):
        one.numpy()


@needs_device
def test_a_non_finite_loss_is_found_and_its_view_is_named():
    setup = on_gpu(Dense(), views=2)
    with counted.Reads():
        state = first_state(setup)
        state.parameters["f_dc"].detach()[0] = torch.nan
        with pytest.raises(NonFiniteError, match="the photometric loss is not finite in step 1"):
            timed_step(setup, state)


@needs_device
@pytest.mark.parametrize("room", [64, 0])
def test_photos_are_kept_on_the_device_as_far_as_memory_allows(room):
    view = sample_scene().train_views[0]
    asked = []

    def full(view):
        asked.append(view.name)
        return view.photo.image(), view.photo.mask()

    with counted.Reads() as reads:
        photos = DevicePhotos(ScaledPhotos(64), counted.device(), room)
        small = view.camera.resized(12, 8)
        for camera in (view.camera, view.camera, small, small, view.camera):
            photo, mask = photos.get(view, camera, full)
            assert photo.shape == (camera.height, camera.width, 3)
            assert photo.device == counted.device()
            assert photo.dtype == torch.uint8
            assert mask is None
        assert not reads.found
    # The small one is made of the photo once; it is kept in the machine's memory, too.
    assert len(asked) == (3 if room else 4)


class NumbaTogether(NumbaRasterizer):
    batched: ClassVar[bool] = True


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "options",
    [
        {"views": 3},
        {"views": 2, "operator": {"name": "pcgrad"}, "exposure": {"name": "affine"}},
        {"views": 2, "backbone": {"name": "scaffold", "voxel_size": 1e-5}},
        {"views": 2, "backbone": {"name": "distance"}, "backward": "joint"},
    ],
    ids=str,
)
def test_views_rendered_together_train_like_views_rendered_one_by_one(options):
    """One backward pass gives the same losses, statistics and parameters to the last bit."""
    config = {"steps": 100, "metrics": [{"name": "psnr"}], **options}
    setup = assemble(RunConfig.model_validate(config), sample_scene(), "none")
    ends = []
    for rasterizer in (NumbaRasterizer(), NumbaTogether()):
        own = moved(setup, rasterizer, torch.device("cpu"))
        state = first_state(own)
        records = [timed_step(own, state) for _ in range(4)]
        ends.append((records, state))
    (alone, one), (joint, other) = ends
    assert [record.losses for record in alone] == [record.losses for record in joint]
    for name, tensor in one.parameters.items():
        assert torch.equal(tensor, other.parameters[name]), name
    assert one.counters == other.counters
    statistics = one.states["densifier"].per_primitive
    for name, total in statistics.items():
        assert torch.equal(total, other.states["densifier"].per_primitive[name]), name
