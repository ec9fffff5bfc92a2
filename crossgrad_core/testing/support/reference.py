"""Contract checks that compare rasterizers with rasterizer `torch` in float64, the reference.

The inputs are ordinary Gaussians, cameras with unusual intrinsics, and extreme Gaussians that occur
in training. A pixel may differ from the reference for two reasons. First, rounding can add or
remove a few Gaussians at the edge of their footprints. Second, float32 has rounding errors. The
size of rounding errors is measured by running the reference itself in float32.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians, Render
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.defaults import REFERENCE_RASTERIZER
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import sample_camera, sample_gaussians, sample_scene
from crossgrad_core.testing.support.contract import Check, ContractError, Make, cannot_tell, require

#: Largest allowed difference between a pixel and the reference. A difference of this size occurs if
#: rounding adds or removes a few Gaussians at the edge of their footprints.
_PIXEL = 0.02
#: Largest allowed mean difference of pixels, and largest allowed relative difference of gradients.
_MEAN, _GRADIENT = 2e-4, 2e-2
#: A rasterizer's rounding error may be this many times the rounding error of the reference in
#: float32.
_ROUNDINGS = 8.0
#: Colour of the background; each channel has a different value.
_BACKGROUND = (0.1, 0.5, 0.9)
#: How each output is computed, as part of error messages.
_RULES = {
    "image": "blend front to back over the background, by the common rules",
    "alpha": "alpha is 1 minus the transmittance",
    "depth": "depth is the sum of weight times camera depth, not divided by alpha",
}


def device_of(rasterizer: Rasterizer) -> torch.device:
    """Return the device on which the checks run.

    Raises:
        SkipTest: The rasterizer needs a device that is not available.
    """
    if "cpu" in rasterizer.devices:
        return torch.device("cpu")
    if "cuda" in rasterizer.devices and torch.cuda.is_available():
        return torch.device("cuda")
    raise cannot_tell(f"it needs one of the devices {sorted(rasterizer.devices)}")


def tensors_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return the tensors of Gaussians by name, except tensors that are None."""
    values = {member.name: getattr(gaussians, member.name) for member in fields(gaussians)}
    return {name: value for name, value in values.items() if isinstance(value, Tensor)}


def moved(
    gaussians: Gaussians, device: torch.device, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """Copy Gaussians to a device, as leaf tensors that require gradients."""
    leaves: dict[str, Any] = {
        name: tensor.detach().clone().to(device, dtype).requires_grad_()
        for name, tensor in tensors_of(gaussians).items()
    }
    return replace(gaussians, **leaves)


@dataclass(frozen=True)
class _Case:
    """The input of one render: Gaussians, a camera and options.

    Attributes:
        name: Description of what is special about the input.
        gaussians: The Gaussians, in float32.
        camera: The camera.
        options: Options of the rasterizer, by name.
    """

    name: str
    gaussians: Gaussians
    camera: Camera = field(default_factory=sample_camera)
    options: Mapping[str, float] = field(default_factory=dict)


def _usual() -> Iterator[_Case]:
    for harmonics in (False, True):
        yield _Case("usual Gaussians", sample_gaussians(harmonics=harmonics))
    lower = replace(sample_gaussians(harmonics=True), sh_degree=1)
    yield _Case("an active degree (sh_degree) below that of the coefficients", lower)


def _cameras() -> Iterator[_Case]:
    gaussians, camera = sample_gaussians(harmonics=True), sample_camera()
    for view in sample_scene().train_views[1::3]:
        yield _Case(f"camera of view {view.name} (world_to_camera)", gaussians, view.camera)
    aside = replace(camera, cx=camera.cx + 5.0, cy=camera.cy - 3.0)
    yield _Case("principal point (cx, cy) away from the middle", gaussians, aside)
    stretched = replace(camera, fx=1.4 * camera.fx, fy=0.8 * camera.fy)
    yield _Case("two focal lengths (fx, fy)", gaussians, stretched)
    larger = replace(camera, width=camera.width + 17, height=camera.height + 3)
    yield _Case("image of another size (width, height)", gaussians, larger)


def _extremes() -> Iterator[_Case]:
    gaussians = sample_gaussians()
    ramp = torch.linspace(0.0, 1.0, len(gaussians))
    with torch.no_grad():
        changed: dict[str, Mapping[str, Tensor]] = {
            "opacities from 0 to 1": {"opacities": ramp},
            "opaque layers, one behind the other": {"opacities": 0.95 + 0.05 * ramp},
            "needles": {"scales": gaussians.scales * torch.tensor([4.0, 0.02, 0.02])},
            "Gaussians larger than the image": {"scales": 10.0 * gaussians.scales},
            "Gaussians far smaller than a pixel": {"scales": 1e-3 * gaussians.scales},
            "quaternions of other lengths": {
                "quats": gaussians.quats * 10.0 ** (4.0 * ramp - 2.0)[:, None]
            },
            "Gaussians beside and behind the camera": {"means": 8.0 * gaussians.means},
            "colours below 0 and above 1": {"colors": 4.0 * ramp[:, None].expand(-1, 3) - 2.0},
        }
    for name, tensors in changed.items():
        fields: dict[str, Any] = dict(tensors)
        yield _Case(name, replace(gaussians, **fields))


def _options() -> Iterator[_Case]:
    gaussians, camera = sample_gaussians(), sample_camera()
    opaque = replace(gaussians, opacities=torch.full_like(gaussians.opacities, 0.95))
    yield _Case("option max_alpha = 0.5", opaque, options={"max_alpha": 0.5})
    yield _Case("option dilation = 2", gaussians, options={"dilation": 2.0})
    depths = _depths(gaussians, camera).sort().values
    # Choose the depth in the middle of the widest gap between Gaussians. At this depth, rounding
    # cannot move a Gaussian across the near plane.
    inner = slice(len(depths) // 4, 3 * len(depths) // 4)
    gaps = depths.diff()[inner]
    widest = int(gaps.argmax()) + len(depths) // 4
    near = float(depths[widest : widest + 2].mean())
    yield _Case(f"option near = {near:.3g}", gaussians, options={"near": near})


def _depths(gaussians: Gaussians, camera: Camera) -> Tensor:
    pose = camera.world_to_camera.double()
    return gaussians.means.detach().double() @ pose[2, :3] + pose[2, 3]


@dataclass(frozen=True)
class _Drawn:
    """The outputs and gradients of one render, as float64 tensors on the CPU.

    Attributes:
        pixels: Image, alpha and, for rasterizers that provide it, depth.
        gradients: Gradients of the tensors of the Gaussians, and gradients in the screen
            statistics.
    """

    pixels: Mapping[str, Tensor]
    gradients: Mapping[str, Tensor]


def _drawn(
    rasterizer: Rasterizer,
    case: _Case,
    outputs: frozenset[str],
    dtype: torch.dtype = torch.float32,
) -> _Drawn:
    gaussians = moved(case.gaussians, device_of(rasterizer), dtype)
    background = torch.tensor(_BACKGROUND, dtype=dtype, device=gaussians.means.device)
    render = rasterizer.render(gaussians, case.camera, background, outputs)
    _weighted(render).backward()  # type: ignore[no-untyped-call]
    pixels = {"image": render.image, "alpha": render.alpha, "depth": render.depth}
    gradients = {
        f"gradient of {name}": tensor.grad for name, tensor in tensors_of(gaussians).items()
    }
    gradients["screen.mean_gradient"] = render.screen.mean_gradient
    gradients["screen.abs_gradient"] = render.screen.abs_gradient
    return _Drawn(_given(pixels), _given(gradients))


def _given(tensors: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    """Return the tensors as float64 on the CPU, except tensors that are None."""
    return {n: t.detach().cpu().double() for n, t in tensors.items() if t is not None}


def _weighted(render: Render) -> Tensor:
    """Return a weighted sum of all outputs. Every pixel and channel has a different weight."""
    channels = [render.image, render.alpha[..., None]]
    if render.depth is not None:
        channels.append(render.depth[..., None])
    whole = torch.cat(channels, -1)
    weights = torch.linspace(0.5, 1.5, whole.numel(), dtype=whole.dtype, device=whole.device)
    return (whole * weights.reshape(whole.shape)).sum()


def _require_same(rasterizer: Rasterizer, case: _Case) -> None:
    """Require that image, alpha, depth, gradients and statistics match the reference."""
    shared = {name: getattr(rasterizer, name) for name in Rasterizer.model_fields}
    reference = build(Rasterizer, REFERENCE_RASTERIZER, shared)
    outputs = rasterizer.provides & {"depth", "abs_gradient"}
    exact = _drawn(reference, case, outputs, torch.float64)
    rounded = _drawn(reference, case, outputs)
    tested = _drawn(rasterizer, case, outputs)
    for name, expected in exact.pixels.items():
        _require_pixels(case.name, name, tested.pixels, expected, rounded.pixels[name])
    for name, expected in exact.gradients.items():
        _require_gradient(case.name, name, tested.gradients, expected, rounded.gradients[name])


def _require_pixels(
    case: str, name: str, drawn: Mapping[str, Tensor], expected: Tensor, rounded: Tensor
) -> None:
    require(name in drawn, f"{case}: render gives no {name}")
    error, lost = (drawn[name] - expected).abs(), (rounded - expected).abs()
    # If a Gaussian at its edge is missing, the depth error is proportional to the Gaussian's
    # distance.
    size = max(1.0, float(expected.abs().max()))
    most = _PIXEL * size + _ROUNDINGS * float(lost.max())
    mean = _MEAN * size + _ROUNDINGS * float(lost.mean())
    require(
        error.max() < most and error.mean() < mean,
        f"{case}: {name} of render differs from rasterizer {REFERENCE_RASTERIZER} by up to "
        f"{float(error.max()):.2g}, {float(error.mean()):.2g} in the mean; expected at most "
        f"{most:.2g} and {mean:.2g}: {_RULES[name]} (docs/rasterizers.md)",
    )


def _require_gradient(
    case: str, name: str, drawn: Mapping[str, Tensor], expected: Tensor, rounded: Tensor
) -> None:
    size = float(expected.norm())
    if size == 0.0:
        return
    require(name in drawn, f"{case}: the {name} is missing")
    error = float((drawn[name] - expected).norm()) / size
    most = _GRADIENT + _ROUNDINGS * float((rounded - expected).norm()) / size
    require(
        error < most,
        f"{case}: the {name} is {error:.2g} of its length off that of rasterizer "
        f"{REFERENCE_RASTERIZER}; expected at most {most:.2g}: image, alpha and depth are "
        "differentiable in every tensor of the Gaussians",
    )


def the_reference_draws_the_same(make: Make[Rasterizer]) -> None:
    """Image, alpha, depth, gradients and statistics match rasterizer `torch` in float64."""
    _require_all(make(), _usual)


def the_camera_is_heeded(make: Make[Rasterizer]) -> None:
    """The render uses the pose, focal lengths, principal point and image size of the camera."""
    _require_all(make(), _cameras)


def extreme_gaussians_are_drawn_alike(make: Make[Rasterizer]) -> None:
    """Opaque, transparent, thin, very large and very small Gaussians match the reference."""
    _require_all(make(), _extremes)


def _require_all(rasterizer: Rasterizer, cases: Callable[[], Iterator[_Case]]) -> None:
    for case in cases():
        _require_same(rasterizer, case)


def its_options_are_heeded(make: Make[Rasterizer]) -> None:
    """The options `max_alpha`, `near` and `dilation` work as the rules define.

    A rasterizer may also support only one value of an option.
    """
    rasterizer, tried = make(), 0
    for case in _options():
        try:
            changed = type(rasterizer).model_validate({**rasterizer.model_dump(), **case.options})
        except ValidationError:
            continue  # The rasterizer supports only one value of this option.
        tried += 1
        _require_same(changed, case)
    if not tried:
        raise cannot_tell("the rasterizer supports only one value of max_alpha, near and dilation")


def views_drawn_together_are_the_same(make: Make[Rasterizer]) -> None:
    """`render_views` returns the images that `render` returns for each single view.

    Each view has its own background.
    """
    rasterizer = make()
    device = device_of(rasterizer)
    gaussians = [moved(sample_gaussians(number), device) for number in (30, 30, 12)]
    cameras = [view.camera for view in sample_scene().train_views[:3]]
    backgrounds = [torch.full((3,), level, device=device) for level in (0.0, 0.5, 1.0)]
    views = list(zip(gaussians, cameras, strict=True))
    with torch.no_grad():
        together = rasterizer.render_views(views, backgrounds)
        alone = [
            rasterizer.render(*view, behind)
            for view, behind in zip(views, backgrounds, strict=True)
        ]
    if len(together) != len(alone):
        raise ContractError(f"render_views returned {len(together)} renders for {len(alone)} views")
    for number, (one, other) in enumerate(zip(together, alone, strict=True), 1):
        error = float((one.image - other.image).abs().max())
        require(
            error < _PIXEL,
            f"view {number} of {len(alone)}: the image of render_views differs from that of render "
            f"by up to {error:.2g}; expected the same image",
        )


REFERENCE_CHECKS: tuple[Check[Rasterizer], ...] = (
    the_reference_draws_the_same,
    the_camera_is_heeded,
    its_options_are_heeded,
    extreme_gaussians_are_drawn_alike,
    views_drawn_together_are_the_same,
)
