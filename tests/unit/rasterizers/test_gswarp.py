"""Rasterizer `gswarp`: what it hands over and takes back, held against the rule set.

gswarp draws on a GPU only, so that a stand-in with its interface draws here: it reads nothing but
the matrices, slopes and tensors that gswarp gets, and answers in gswarp's layout and units.
"""

import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, NamedTuple

import pytest
import torch
from support.gaussians import posed_camera, random_gaussians
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.errors import UserError
from crossgrad_plugins.rasterizers.gswarp_cuda import GswarpRasterizer, settings_of
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

CAMERA = posed_camera(40, 28, focal=30.0, principal=(0.5, 0.5))
OFF_AXIS = posed_camera(40, 28, focal=30.0, principal=(0.3, 0.8))
#: gswarp draws what is deeper than this.
NEAR = 0.2


class Settings(NamedTuple):
    """gswarp's settings, in the order of its own."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool = False
    antialiasing: bool = False
    backward_mode: str | None = None
    binning_sort_mode: str | None = None
    auto_tune: bool = True
    auto_tune_verbose: bool = True


class Meta(NamedTuple):
    depth: Tensor
    alpha: Tensor


@dataclass
class Rasterizer:
    """Draws by our reference the scene and camera that the settings describe."""

    settings: Settings

    def camera(self):
        s = self.settings
        pose = s.viewmatrix.T.double()
        matrix = s.projmatrix.T.double() @ torch.linalg.inv(pose)
        width, height = s.image_width, s.image_height
        assert matrix[0, 0] == pytest.approx(1 / s.tanfovx, rel=1e-5)
        assert matrix[1, 1] == pytest.approx(1 / s.tanfovy, rel=1e-5)
        # A point at ((v + 1) * size - 1) / 2 has the centre of the first pixel at 0.
        cx, cy = (matrix[0, 2] + 1) * width / 2, (matrix[1, 2] + 1) * height / 2
        fx, fy = matrix[0, 0] * width / 2, matrix[1, 1] * height / 2
        return Camera(width, height, float(fx), float(fy), float(cx), float(cy), pose)

    def __call__(self, *, means3D, means2D, opacities, scales, rotations, **colors):
        assert torch.allclose(rotations.norm(dim=-1), torch.ones(len(rotations)))
        gaussians = Gaussians(
            means3D, rotations, scales, opacities[:, 0], **self.own_colors(**colors)
        )
        reference = TorchRasterizer(near=NEAR, footprint="3-sigma")
        moved, shift = _shifted(gaussians, self.camera(), means2D)
        render = reference.render(moved, shift, self.settings.bg, frozenset({"depth"}))
        radii = render.screen.radii
        return render.image.permute(2, 0, 1), radii, Meta(render.depth[None], render.alpha[None])

    def own_colors(self, colors_precomp=None, shs=None):
        if shs is None:
            return {"colors": colors_precomp}
        degree = self.settings.sh_degree
        assert shs.shape[1] == (degree + 1) ** 2
        center = self.camera().center.float()
        torch.testing.assert_close(self.settings.campos, center, rtol=1e-4, atol=1e-4)
        return {"sh_dc": shs[:, :1], "sh_rest": shs[:, 1:], "sh_degree": degree}


def _shifted(gaussians: Gaussians, camera: Camera, means2d: Tensor) -> tuple[Gaussians, Any]:
    """The Gaussians moved so that their projected means move by `means2d` in NDC units."""
    pose = camera.world_to_camera.float()
    depth = gaussians.means.detach() @ pose[2, :3] + pose[2, 3]
    half = torch.tensor([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
    local = torch.cat([means2d[:, :2] * half * depth[:, None], torch.zeros_like(depth[:, None])], 1)
    return replace(gaussians, means=gaussians.means + local @ pose[:3, :3]), camera


@pytest.fixture
def gswarp(monkeypatch):
    module: Any = ModuleType("gswarp")
    module.GaussianRasterizationSettings, module.GaussianRasterizer = Settings, Rasterizer
    monkeypatch.setitem(sys.modules, "gswarp", module)
    return GswarpRasterizer(near=0.05)


def leaves(gaussians):
    return gaussians.mapped(lambda tensor: tensor.float().detach().requires_grad_())


@pytest.mark.parametrize("camera", [CAMERA, OFF_AXIS], ids=["middle", "off the axis"])
@pytest.mark.parametrize("sh_degree", [None, 0, 1, 3])
def test_gswarp_inputs_and_outputs_agree_with_the_reference(gswarp, camera, sh_degree):
    scene = random_gaussians(30, camera, seed=6, sh_degree=sh_degree)
    mine, theirs = leaves(scene), leaves(scene)
    reference = TorchRasterizer(near=0.05, footprint="3-sigma")
    background, outputs = torch.tensor([0.1, 0.5, 0.3]), frozenset({"depth"})
    for rasterizer, gaussians in ((reference, mine), (gswarp, theirs)):
        render = rasterizer.render(gaussians, camera, background, outputs)
        (render.image.square().sum() + render.alpha.sum()).backward()
        if rasterizer is reference:
            ours = render
    for name in ("image", "alpha", "depth"):
        torch.testing.assert_close(getattr(render, name), getattr(ours, name), rtol=0, atol=1e-4)
    assert torch.equal(render.screen.radii, ours.screen.radii)
    for one, two in zip(theirs.floats(), mine.floats(), strict=True):
        assert (one.grad - two.grad).norm() <= 2e-3 * two.grad.norm()


def test_the_option_near_sets_the_near_plane_of_gswarp(gswarp):
    """The default near plane of gswarp is at 0.2 units."""
    camera = replace(CAMERA, world_to_camera=torch.eye(4, dtype=torch.float64))
    scene = random_gaussians(2, camera, border=-0.4, sigmas=(2.0, 3.0))
    depths = torch.tensor([0.049, 0.051], dtype=torch.float64)
    means = torch.stack([torch.zeros(2), torch.zeros(2), depths], 1)
    scene = replace(scene, means=means, scales=torch.full((2, 3), 0.003, dtype=torch.float64))
    radii = gswarp.render(leaves(scene), camera, torch.zeros(3)).screen.radii
    assert (radii > 0).tolist() == [False, True]


def test_the_gradient_of_projected_means_is_per_pixel(gswarp):
    scene = random_gaussians(20, CAMERA, seed=8, border=-0.1, sigmas=(0.8, 1.2))
    reference = TorchRasterizer(near=0.05, footprint="3-sigma")
    mine, theirs = leaves(scene), leaves(scene)
    renders = []
    for rasterizer, gaussians in ((reference, mine), (gswarp, theirs)):
        render = rasterizer.render(gaussians, CAMERA, torch.zeros(3))
        render.image.square().sum().backward()
        renders.append(render.screen.mean_gradient)
    ours, found = renders
    assert found.shape == ours.shape
    assert (found - ours).norm() < 0.25 * ours.norm()


def test_an_empty_model_gives_the_background(gswarp):
    scene = leaves(random_gaussians(0, CAMERA))
    render = gswarp.render(scene, CAMERA, torch.tensor([0.2, 0.4, 0.6]))
    assert render.image.shape == (28, 40, 3)
    assert not render.alpha.any()
    assert len(render.screen.radii) == 0
    render.image.sum().backward()
    assert scene.means.grad.shape == (*render.screen.mean_gradient.shape[:1], 3)


def test_a_package_that_cannot_be_imported_gives_a_message(monkeypatch):
    monkeypatch.setitem(sys.modules, "gswarp", None)
    with pytest.raises(UserError, match="GswarpRasterizer cannot draw on this machine"):
        GswarpRasterizer().self_test("cpu")


def test_gswarp_matrices_project_a_point_to_the_same_pixel_as_the_camera():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    points[:, 2] += 4.0
    pixels, depths = OFF_AXIS.project(points.numpy())
    found = settings_of(OFF_AXIS, torch.zeros(3), 4.0, 0)
    enlarged = torch.cat([points * 4.0, torch.ones(50, 1, dtype=torch.float64)], 1).float()
    x, y, _, w = (enlarged @ found["projmatrix"]).unbind(-1)
    ahead = torch.from_numpy(depths) > 0.1
    size = torch.tensor([40.0, 28.0])
    # gswarp's pixel 0 has its centre at 0, ours at 0.5.
    theirs = ((torch.stack([x, y], -1) / w[:, None] + 1) * size - 1) / 2 + 0.5
    torch.testing.assert_close(
        theirs[ahead], torch.from_numpy(pixels).float()[ahead], rtol=1e-4, atol=1e-3
    )
    torch.testing.assert_close(w, 4.0 * torch.from_numpy(depths).float(), rtol=1e-4, atol=1e-4)
