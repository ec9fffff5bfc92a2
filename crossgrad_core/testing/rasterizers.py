"""Contract checks for rasterizers: shapes, gradients, statistics, and the common rules."""

from dataclasses import replace

import torch
from pydantic import ValidationError
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians, OnDemand, Render, Screen
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.testing.fixtures import HEIGHT, WIDTH, sample_camera, sample_gaussians
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, Make, cannot_tell, require
from crossgrad_core.testing.support.reference import REFERENCE_CHECKS, device_of, moved, tensors_of

_ROUNDING = 1e-4


def _drawn(
    rasterizer: Rasterizer, gaussians: Gaussians, level: float = 0.0, *, backward: bool = False
) -> Render:
    """Render with all optional outputs over a grey background.

    With `backward`, also run the backward pass.
    """
    background = torch.full((3,), level, device=gaussians.means.device)
    render = rasterizer.render(gaussians, sample_camera(), background, rasterizer.provides)
    if backward:
        _backward(_loss(render))
    return render


def _loss(render: Render) -> Tensor:
    """Return a weighted sum of the image. Every pixel has a different weight."""
    weights = torch.linspace(0.5, 1.5, render.image.numel()).reshape(render.image.shape)
    return (render.image * weights.to(render.image)).sum()


def _backward(loss: Tensor) -> None:
    loss.backward()  # type: ignore[no-untyped-call]


def _shape(name: str, tensor: Tensor | None, *expected: int) -> None:
    shape = None if tensor is None else list(tensor.shape)
    require(shape == list(expected), f"{name} has the shape {shape}, expected {list(expected)}")


def renders_have_the_shape(make: Make[Rasterizer]) -> None:
    """Image [H, W, 3], alpha [H, W], radii [N] int32 and optional outputs have the right shapes."""
    rasterizer = make()
    gaussians = moved(sample_gaussians(), device_of(rasterizer))
    render = _drawn(rasterizer, gaussians)
    _shape("image", render.image, HEIGHT, WIDTH, 3)
    _shape("alpha", render.alpha, HEIGHT, WIDTH)
    _shape("screen.radii", render.screen.radii, len(gaussians))
    require(render.screen.radii.dtype == torch.int32, "screen.radii is not int32")
    require(render.image.dtype == torch.float32, "float32 Gaussians give an image of another type")
    if "depth" in rasterizer.provides:
        _shape("depth", render.depth, HEIGHT, WIDTH)
    if "pixels" in rasterizer.provides:
        _shape("screen.pixels", render.screen.pixels, len(gaussians))


def the_background_shows_through(make: Make[Rasterizer]) -> None:
    """Each pixel is the blended colour plus (1 - alpha) times the background colour."""
    rasterizer = make()
    gaussians = moved(sample_gaussians(), device_of(rasterizer))
    black, white = _drawn(rasterizer, gaussians), _drawn(rasterizer, gaussians, 1.0)
    error = (white.image - black.image - (1.0 - black.alpha)[..., None]).detach().abs().max()
    require(error < _ROUNDING, f"the background is added with an error of {float(error):.2g}")
    inside = (black.alpha >= 0.0).all() and (black.alpha <= 1.0).all()
    require(inside, "alpha is outside [0, 1]")


def nothing_to_draw_is_no_error(make: Make[Rasterizer]) -> None:
    """If no Gaussian is in front of the camera, the image is the background and all radii are 0."""
    rasterizer = make()
    device = device_of(rasterizer)
    sample = moved(sample_gaussians(), device)
    behind = 2.0 * sample_camera().center.to(device).float()
    for gaussians, what in (
        (moved(sample_gaussians(0), device), "no Gaussians"),
        (replace(sample, means=(sample.means.detach() + behind).requires_grad_()), "all behind"),
    ):
        render = _drawn(rasterizer, gaussians, 0.25)
        require((render.image == 0.25).all(), f"{what}: the image is not the background")  # noqa: PLR2004
        require((render.alpha == 0.0).all(), f"{what}: alpha is not 0")
        require((render.screen.radii == 0).all(), f"{what}: a radius is not 0")


def gradients_reach_every_input(make: Make[Rasterizer]) -> None:
    """Every tensor of the Gaussians receives a finite gradient that is not zero everywhere."""
    rasterizer = make()
    for harmonics in (False, True):
        gaussians = moved(sample_gaussians(harmonics=harmonics), device_of(rasterizer))
        _drawn(rasterizer, gaussians, backward=True)
        for name, tensor in tensors_of(gaussians).items():
            gradient = tensor.grad
            require(gradient is not None, f"{name} receives no gradient")
            if gradient is not None:
                require(gradient.isfinite().all(), f"the gradient of {name} is not finite")
                require(gradient.any(), f"the gradient of {name} is zero")


def statistics_are_filled(make: Make[Rasterizer]) -> None:
    """The backward pass fills the screen statistics that density control reads."""
    rasterizer = make()
    gaussians = moved(sample_gaussians(), device_of(rasterizer))
    screen = _drawn(rasterizer, gaussians, backward=True).screen
    number = len(gaussians)
    visible = screen.radii > 0
    require(visible.any(), "no Gaussian in front of the camera has a radius")
    _shape("screen.mean_gradient", screen.mean_gradient, number, 2)
    if screen.mean_gradient is not None:
        require(screen.mean_gradient[visible].any(), "screen.mean_gradient is zero")
        unseen = screen.mean_gradient[~visible]
        require(not unseen.any(), "screen.mean_gradient of an invisible Gaussian is not zero")
    if "abs_gradient" in rasterizer.provides:
        _shape("screen.abs_gradient", screen.abs_gradient, number, 2)
        if screen.abs_gradient is not None and screen.mean_gradient is not None:
            short = screen.mean_gradient.abs() - screen.abs_gradient
            scale = screen.abs_gradient.max()
            require(
                short.max() <= _ROUNDING * scale, "screen.abs_gradient is below |mean_gradient|"
            )
    if "directions" in rasterizer.provides:
        _directions_are_of_pixels(screen)
    if "pixels" in rasterizer.provides and screen.pixels is not None:
        require((screen.pixels[~visible] == 0).all(), "an invisible Gaussian has pixels")
        require((screen.pixels[visible] > 0).any(), "no visible Gaussian has pixels")
    if "count" in rasterizer.provides:
        count = screen.count or torch.zeros_like
        third = torch.arange(HEIGHT * WIDTH, device=visible.device).view(HEIGHT, WIDTH) % 3 == 0
        whole, parts = count(third | True), count(third) + count(~third)
        require(
            whole.any() and torch.equal(whole, parts),
            "screen.count does not count the expected pixels",
        )
        same = screen.pixels is None or torch.equal(whole, screen.pixels)
        require(same, "screen.count with all pixels marked differs from screen.pixels")


def _directions_are_of_pixels(screen: Screen) -> None:
    directions, absolute = screen.directions, screen.abs_gradient
    shape = None if directions is None else tuple(directions.shape)
    wanted = (screen.radii.shape[0], 6, 5)
    require(shape == wanted, f"screen.directions has shape {shape}, expected {wanted}")
    if directions is None:
        return
    length, count = directions[..., :2].norm(dim=-1), directions[..., 4]
    require((length <= count * (1 + _ROUNDING)).all(), "screen.directions are not of unit length")
    require((count == count.round()).all() and count.any(), "screen.directions counts no pixels")
    if absolute is not None:
        short = (directions[..., 2:4].sum(1) - absolute).abs().max()
        same = short <= _ROUNDING * absolute.max()
        require(same, "the bins of screen.directions do not add up to screen.abs_gradient")


def same_input_same_bits(make: Make[Rasterizer]) -> None:
    """Two renders of one input and their gradients are bit-identical.

    The input does not change.
    """
    if not make().deterministic:
        raise cannot_tell("the rasterizer declares that its bits differ between runs")
    results = []
    original = sample_gaussians(harmonics=True)
    for _ in range(2):
        rasterizer = make()
        gaussians = moved(original, device_of(rasterizer))
        render = _drawn(rasterizer, gaussians, backward=True)
        gradients = {name: tensor.grad for name, tensor in tensors_of(gaussians).items()}
        results.append({"image": render.image.detach(), "alpha": render.alpha, **gradients})
        for name, tensor in tensors_of(gaussians).items():
            same = torch.equal(tensor.detach().cpu(), tensors_of(original)[name].detach())
            require(same, f"rendering changes the Gaussians' {name}")
    for name, one in results[0].items():
        other = results[1][name]
        same = one is not None and other is not None and torch.equal(one, other)
        require(same, f"two renders of the same input differ in {name}")


def dilations_of_gaussians_are_heeded(make: Make[Rasterizer]) -> None:
    """A dilation in the Gaussians replaces the dilation option of the rasterizer."""
    rasterizer = make()
    try:
        wider = type(rasterizer)(**{**rasterizer.model_dump(), "dilation": 1.0})
    except ValidationError:
        raise cannot_tell("the rasterizer supports only one dilation") from None
    gaussians = moved(sample_gaussians(harmonics=False), device_of(rasterizer))
    with torch.no_grad():
        plain, widened = (_drawn(variant, gaussians).image for variant in (rasterizer, wider))
        wide = _drawn(rasterizer, replace(gaussians, dilation=1.0)).image
    require(not torch.equal(plain, wide), "the dilation of the Gaussians has no effect")
    error = float((widened - wide).abs().max())
    require(
        error < _ROUNDING,
        f"the dilation of the Gaussians changes pixels by {error:.2g} more than the "
        "same dilation of the rasterizer",
    )


def rows_on_demand_are_asked_for(make: Make[Rasterizer]) -> None:
    """With `sparse_rows`, only rows of visible Gaussians are requested.

    Gradients are sparse, and equal to dense gradients.
    """
    rasterizer = make()
    if not rasterizer.sparse_rows:
        return
    gaussians = moved(sample_gaussians(harmonics=True), device_of(rasterizer))
    with torch.no_grad():
        gaussians.means[::2] = 2.0 * sample_camera().center.to(gaussians.means)
    late = moved(gaussians, gaussians.means.device)
    tensors = {name: getattr(late, name) for name in ("sh_dc", "sh_rest")}
    asked: list[int] = []

    def bring(rows: Tensor | None) -> None:
        chosen = torch.arange(len(gaussians)) if rows is None else rows.long()
        asked.extend(chosen.tolist())
        for name, tensor in tensors.items():
            tensor.data[chosen] = getattr(gaussians, name).detach()[chosen]

    for tensor in tensors.values():
        tensor.data.fill_(torch.nan)
    demand = OnDemand(frozenset(tensors), bring)
    plain = _drawn(rasterizer, gaussians, backward=True)
    render = _drawn(rasterizer, replace(late, on_demand=demand), backward=True)
    require(torch.equal(render.image, plain.image), "sparse rows give another image")
    unseen = not any(row % 2 == 0 for row in asked)
    require(len(set(asked)) == len(asked) and unseen, f"the rows {asked} were requested")
    for name, tensor in tensors.items():
        gradient, expected = tensor.grad, getattr(gaussians, name).grad
        good = gradient is not None and gradient.is_sparse
        require(good, f"the gradient of {name} is not sparse")
        same = gradient is not None and torch.equal(gradient.to_dense(), expected)
        require(same, f"sparse rows give another gradient of {name}")


def speed_says_where_it_runs(make: Make[Rasterizer]) -> None:
    """`speed` is 0 for devices that the rasterizer does not support.

    If `speed` is 0, `--rasterizer auto` never selects the rasterizer for the device.
    """
    rasterizer = make()
    for device in ("cpu", "cuda"):
        speed = rasterizer.speed(device)
        require(
            speed == 0.0 or (speed > 0.0 and device in rasterizer.devices),
            f"speed({device!r}) is {speed}, but the devices are {sorted(rasterizer.devices)}",
        )


RASTERIZER_CHECKS: tuple[Check[Rasterizer], ...] = (
    *COMPONENT_CHECKS,
    speed_says_where_it_runs,
    renders_have_the_shape,
    the_background_shows_through,
    nothing_to_draw_is_no_error,
    gradients_reach_every_input,
    statistics_are_filled,
    same_input_same_bits,
    rows_on_demand_are_asked_for,
    *REFERENCE_CHECKS,
    dilations_of_gaussians_are_heeded,
)
