"""A test before training on a GPU: image, loss and gradients of a small scene must be correct.

Two failures are known that give no error message. The first process on a new machine trained to
only 14 dB (gsplat issue 872), and renders contained uninitialised memory (gsplat issue 1031).
"""

from dataclasses import dataclass
from math import inf
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera, Gaussians, Rasterizer, UserError
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

#: Maximum difference of a pixel value. A difference occurs if some Gaussians differ at the edge of
#: their footprint, by 1/255 each.
PIXEL: Final = 0.02
#: Maximum mean difference of pixel values, and maximum relative difference of the loss.
MEAN: Final = 5e-4
#: Maximum relative difference of the gradients of a tensor.
GRADIENT: Final = 2e-2
_SIZE: Final = (70, 50)
_NUMBER: Final = 200
_TENSORS: Final = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


@dataclass(frozen=True)
class Look:
    """A render of the test scene, copied to the CPU.

    Attributes:
        image: [H, W, 3] the rendered image.
        loss: Mean squared difference from a grey ramp.
        gradients: Tensor name -> gradient of the tensor.
    """

    image: Tensor
    loss: float
    gradients: dict[str, Tensor]


def self_test(rasterizer: Rasterizer, device: str) -> None:
    """Render the test scene with RGB colours and with SH, and compare with the reference.

    The known failures affect the first process and the first call, so the scene is rendered twice.

    Raises:
        UserError: The rasterizer raises an exception, or its result differs from the result of
            rasterizer `torch`.
    """
    for harmonics in (False, True):
        expected = look_at(_reference(rasterizer), "cpu", harmonics=harmonics)
        try:
            look = look_at(rasterizer, device, harmonics=harmonics)
        except UserError:
            raise
        except Exception as error:
            raise _refused(rasterizer, "cannot draw", f"{type(error).__name__}: {error}") from error
        if wrong := difference(look, expected):
            raise _refused(rasterizer, "renders a known scene incorrectly", wrong)


def known_scene(device: str, *, harmonics: bool) -> tuple[Gaussians, Camera]:
    """Return the test scene: Gaussians of a few pixels, some outside the image, and a camera.

    The principal point of the camera is not in the middle.
    """
    random = torch.Generator().manual_seed(872)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        values = torch.rand((_NUMBER, *shape), generator=random) * (high - low) + low
        return values.to(device).requires_grad_()

    gaussians = Gaussians(
        means=uniform(-1.0, 1.0, 3),
        quats=uniform(-1.0, 1.0, 4),
        scales=uniform(0.03, 0.12, 3),
        opacities=uniform(0.1, 0.9),
        colors=None if harmonics else uniform(0.0, 1.0, 3),
        sh_dc=uniform(-1.0, 1.0, 1, 3) if harmonics else None,
        sh_rest=uniform(-0.3, 0.3, 15, 3) if harmonics else None,
        sh_degree=3 if harmonics else 0,
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.1, -0.1, 2.5])
    width, height = _SIZE
    return gaussians, Camera(width, height, 60.0, 62.0, 36.0, 24.0, pose)


def look_at(rasterizer: Rasterizer, device: str, *, harmonics: bool) -> Look:
    """Return image, loss and gradients of the test scene from a rasterizer."""
    gaussians, camera = known_scene(device, harmonics=harmonics)
    background = torch.tensor([0.2, 0.4, 0.6], device=device)
    image = rasterizer.render(gaussians, camera, background).image
    ramp = torch.linspace(0.0, 1.0, image.numel(), device=device).view(image.shape)
    loss = (image - ramp).square().mean()
    loss.backward()  # type: ignore[no-untyped-call]
    tensors = {name: getattr(gaussians, name) for name in _TENSORS}
    gradients = {name: tensor.grad for name, tensor in tensors.items() if tensor is not None}
    cpu_gradients = {name: g.cpu() for name, g in gradients.items() if g is not None}
    return Look(image.detach().cpu(), float(loss.detach()), cpu_gradients)


def difference(found: Look, expected: Look) -> str:
    """Return a text about the first difference; empty if there is none."""
    error = (found.image - expected.image).abs()
    if not (error.max() < PIXEL and error.mean() < MEAN):
        return (
            f"pixels differ by up to {float(error.max()):.2g}, {float(error.mean()):.2g} on average"
        )
    if not abs(found.loss - expected.loss) < MEAN * expected.loss:
        return f"the loss is {found.loss:.6g}, not {expected.loss:.6g}"
    for name, gradient in expected.gradients.items():
        other = found.gradients.get(name, torch.zeros_like(gradient))
        apart, length = float((other - gradient).norm()), float(gradient.norm())
        if not apart <= GRADIENT * length:
            share = apart / length if length else inf
            return f"the gradient of the {name} differs by {share:.2g} of its length"
    return ""


def _reference(rasterizer: Rasterizer) -> TorchRasterizer:
    shared = {name: getattr(rasterizer, name) for name in Rasterizer.model_fields}
    footprint = getattr(rasterizer, "footprint", "alpha")
    return TorchRasterizer(**shared, footprint=footprint)


def _refused(rasterizer: Rasterizer, what: str, found: str) -> UserError:
    return UserError(
        f"{type(rasterizer).__name__} {what} on this machine",
        where="--rasterizer, before the first step",
        expected="the image, loss and gradients of rasterizer torch",
        found=found,
        todo="run the command again, because the first process on a fresh machine can "
        "fail; if it fails again, install packages that match torch's CUDA version, "
        "or use --rasterizer torch",
    )
