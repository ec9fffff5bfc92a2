"""Extreme parameters of backbones: what training can drift into and must survive."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import log

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.testing.fixtures import sample_phase, sample_scene

#: A tensor's gradient shorter than this share of the longest one is the rounding noise of a zero.
NEGLIGIBLE = 1e-9


@dataclass(frozen=True, eq=False)
class Extreme:
    """Parameters and the camera that looks at them.

    Attributes:
        parameters: All tensors of the backbone, without gradient.
        camera: The camera.
    """

    parameters: Parameters
    camera: Camera


#: (parameters of a small scene, camera) -> the extreme.
Case = Callable[[Parameters, Camera], Extreme]


def positions(parameters: Parameters) -> str:
    """Name of the tensor [P, 3] of the primitives' positions."""
    return "means" if "means" in parameters else "anchors"


def one_primitive(parameters: Parameters, camera: Camera) -> Extreme:
    """One primitive is left."""
    return Extreme(_rows(parameters, torch.zeros(1, dtype=torch.int64)), camera)


def all_behind(parameters: Parameters, camera: Camera) -> Extreme:
    """Nothing is visible: everything is behind the camera."""
    name = positions(parameters)
    behind = _center(camera) - 3.0 * _forward(camera)
    return Extreme(_with(parameters, name, behind + 0.1 * parameters[name].detach()), camera)


def all_faint(parameters: Parameters, camera: Camera) -> Extreme:
    """No opacity reaches 1/255; those that an MLP decodes are all negative."""
    if "opacities" in parameters:
        opacities = torch.full_like(parameters["opacities"].detach(), -30.0)
        return Extreme(_with(parameters, "opacities", opacities), camera)
    (name,) = [name for name in parameters if name.startswith("mlp_opacity") and "2.bias" in name]
    return Extreme(_with(parameters, name, torch.full_like(parameters[name], -30.0)), camera)


def tiny(parameters: Parameters, camera: Camera) -> Extreme:
    """Standard deviations of 1e-12 local units."""
    return Extreme(_sized(parameters, (1e-12, 2e-12, 3e-12)), camera)


def huge(parameters: Parameters, camera: Camera) -> Extreme:
    """Standard deviations of a million local units."""
    return Extreme(_sized(parameters, (1e6, 2e6, 3e6)), camera)


def needles(parameters: Parameters, camera: Camera) -> Extreme:
    """Axes of a million to one."""
    return Extreme(_sized(parameters, (0.5, 0.5e-6, 0.5e-6)), camera)


def camera_inside(parameters: Parameters, camera: Camera) -> Extreme:
    """The camera is inside every Gaussian, just behind its centre."""
    name = positions(parameters)
    center = _center(camera) + 0.01 * _forward(camera)
    moved = _with(parameters, name, center + 0.001 * parameters[name].detach())
    return Extreme(_sized(moved, (0.3, 0.2, 0.4)), camera)


def on_the_camera_plane(parameters: Parameters, camera: Camera) -> Extreme:
    """Half of the centres have a camera depth of zero to rounding."""
    name = positions(parameters)
    points = parameters[name].detach().double()
    depth = (points - _center(camera)) @ _forward(camera)
    points[::2] -= depth[::2, None] * _forward(camera)
    return Extreme(_with(parameters, name, points.float()), camera)


def crowded_pixel(parameters: Parameters, camera: Camera, crowd: int) -> Extreme:
    """A crowd of Gaussians, faint ones, is in one pixel of a picture of 4 x 4."""
    count = parameters[positions(parameters)].shape[0]
    if "offsets" in parameters:
        crowd //= parameters["offsets"].shape[1]
    many = _rows(parameters, torch.arange(crowd) % count)
    name = positions(many)
    share = torch.arange(crowd, dtype=torch.float64)[:, None] / crowd
    along = (1.0 + share) * _forward(camera)
    spread = 1e-3 * torch.sin(torch.arange(3.0 * crowd, dtype=torch.float64)).reshape(crowd, 3)
    many = _with(many, name, (_center(camera) + along + spread).float())
    many = _sized(many, (0.2, 0.3, 0.1))
    if "opacities" in many:
        many = _with(many, "opacities", torch.full((crowd,), log(0.01 / 0.99)))
    small = replace(camera, width=4, height=4, fx=8.0, fy=8.0, cx=2.0, cy=2.0)
    return Extreme(many, small)


def cases(crowd: int) -> dict[str, Case]:
    """All extremes by name, with so many Gaussians in the crowded pixel."""
    return {
        "one primitive": one_primitive,
        "nothing visible": all_behind,
        "all faint": all_faint,
        "scales 1e-12": tiny,
        "scales 1e+6": huge,
        "needles 1e6 : 1": needles,
        "camera inside": camera_inside,
        "on the camera plane": on_the_camera_plane,
        "crowded pixel": partial(crowded_pixel, crowd=crowd),
    }


def jittered(backbone: Backbone, seed: int = 0) -> Parameters:
    """Parameters of the sample scene moved about, so that no gradient is zero by symmetry."""
    rng = np.random.default_rng(seed)
    scene = sample_scene()
    parameters = backbone.create(scene, rng)
    trained = {name for block in backbone.trained_blocks() for name in block.tensors}
    for name in sorted(trained - {"means"}):
        noise = rng.normal(0.0, 0.3, tuple(parameters[name].shape)).astype(np.float32)
        parameters[name] = parameters[name].detach() + torch.from_numpy(noise)
    return backbone.prepare(parameters, scene, sample_phase())


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a backbone and a rasterizer make of an extreme.

    Attributes:
        image: [H, W, 3] over grey.
        loss: Sum of squared differences from a fixed pattern.
        gradients: Its gradient by each trained tensor, zero where there is none.
    """

    image: Tensor
    loss: float
    gradients: Parameters

    @property
    def finite(self) -> bool:
        """Whether everything is."""
        values = [self.image, torch.tensor(self.loss), *self.gradients.values()]
        return all(bool(value.isfinite().all()) for value in values)

    def image_error(self, exact: "Outcome") -> float:
        """Largest difference of a channel of a pixel."""
        return float((self.image.double() - exact.image).abs().max())

    def gradient_error(self, exact: "Outcome") -> float:
        """Largest relative L2 error of a tensor's gradient; tensors that do not matter left out."""
        lengths = {name: float(wanted.norm()) for name, wanted in exact.gradients.items()}
        least = NEGLIGIBLE * max(lengths.values())
        errors = [0.0]
        for name, length in lengths.items():
            if length > least:
                difference = self.gradients[name].double() - exact.gradients[name]
                errors.append(float(difference.norm()) / length)
        return max(errors)


def outcome(
    backbone: Backbone, rasterizer: Rasterizer, extreme: Extreme, dtype: torch.dtype
) -> Outcome:
    """Decodes, draws and differentiates in the given number type."""
    trained = {name for block in backbone.trained_blocks() for name in block.tensors}
    parameters = {
        name: tensor.detach().to(dtype).requires_grad_(name in trained)
        if tensor.is_floating_point()
        else tensor
        for name, tensor in extreme.parameters.items()
    }
    gaussians = backbone.decode(parameters, extreme.camera, sample_phase())
    grey = torch.full((3,), 0.5, dtype=dtype)
    image = rasterizer.render(gaussians, extreme.camera, grey).image
    pattern = torch.sin(torch.arange(image.numel(), dtype=dtype)).reshape(image.shape)
    loss = ((image - pattern) ** 2).sum()
    if loss.requires_grad:
        loss.backward()  # type: ignore[no-untyped-call]
    gradients = {}
    for name in trained:
        gradient = parameters[name].grad
        gradients[name] = torch.zeros_like(parameters[name]) if gradient is None else gradient
    return Outcome(image.detach(), float(loss.detach()), gradients)


def _rows(parameters: Parameters, rows: Tensor) -> Parameters:
    """The given rows of every tensor that has a row per primitive."""
    count = parameters[positions(parameters)].shape[0]
    return {
        name: tensor.detach()[rows] if tensor.dim() > 0 and tensor.shape[0] == count else tensor
        for name, tensor in parameters.items()
    }


def _with(parameters: Parameters, name: str, value: Tensor) -> Parameters:
    return {**parameters, name: value.to(parameters[name].dtype)}


def _sized(parameters: Parameters, sigmas: tuple[float, float, float]) -> Parameters:
    """The last three columns of `scales`, which size the Gaussians of every backbone."""
    scales = parameters["scales"].detach().clone()
    scales[:, -3:] = torch.tensor(sigmas, dtype=torch.float64).log().to(scales)
    return _with(parameters, "scales", scales)


def _center(camera: Camera) -> Tensor:
    return camera.center.double()


def _forward(camera: Camera) -> Tensor:
    """[3] viewing direction, unit length, float64."""
    return camera.world_to_camera[2, :3].double()
