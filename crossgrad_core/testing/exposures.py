"""Contract checks for exposures."""

from collections.abc import Mapping

import torch
from torch import Tensor

from crossgrad_core.contract.slots.exposure import Exposure, Fitted
from crossgrad_core.registry.entries import load
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, Make, cannot_tell, require

#: Largest difference between parameters that were projected once and parameters that were projected
#: twice.
_ROUNDING = 1e-5


def fitting_gives_an_installed_one(make: Make[Exposure]) -> None:
    """`fitted_to` returns a `Fitted` with an exposure, the name of its type, and notes."""
    exposure = make()
    fitted = exposure.fitted_to(sample_scene())
    require(isinstance(fitted, Fitted), f"fitted_to() returns {fitted!r}, not a Fitted")
    are_texts = isinstance(fitted.notes, tuple) and all(
        isinstance(note, str) for note in fitted.notes
    )
    require(are_texts, f"the notes of fitted_to() are {fitted.notes!r}, not a tuple of strings")
    kind = type(exposure) if fitted.name is None else load(Exposure, fitted.name)
    right = type(fitted.exposure) is kind
    require(right, f"fitted_to() returns {fitted.exposure!r} under the name {fitted.name!r}")


def every_photo_has_a_start(make: Make[Exposure]) -> None:
    """Each parameter is trained, and starts with one finite float32 row for each training photo."""
    for name, parameter in make().per_photo(sample_scene()).items():
        _require_rows(f"the initial value of {name}", parameter.first())
        require(parameter.lr.initial > 0, f"the learning rate of {name} is {parameter.lr.initial}")


def an_image_stays_an_image(make: Make[Exposure]) -> None:
    """An image of any size or value range stays finite and keeps its shape and type.

    The input is not modified.
    """
    exposure, values = make(), _first(_starts(make()))
    for image in (_image(), _image()[:5, :9], 3.0 * _image() - 1.0, torch.zeros(4, 4, 3)):
        kept = image.clone()
        taken = exposure.apply(image, values)
        require(
            taken.shape == image.shape, f"the shape {list(image.shape)} became {list(taken.shape)}"
        )
        require(taken.dtype == image.dtype, f"the type {image.dtype} became {taken.dtype}")
        require(taken.isfinite().all(), "the exposed image is not finite")
        require(torch.equal(image, kept), "the exposure changes the render that it received")


def gradients_reach_render_and_values(make: Make[Exposure]) -> None:
    """The exposed image has gradients with respect to the render and to every parameter."""
    exposure = make()
    values = {name: row.clone().requires_grad_() for name, row in _first(_starts(exposure)).items()}
    image = _image().requires_grad_()
    taken = exposure.apply(image, values)
    weights = torch.rand(taken.shape, generator=torch.Generator().manual_seed(4))
    inputs = {"the render": image, **values}
    gradients = torch.autograd.grad(
        (taken * weights).sum(), list(inputs.values()), allow_unused=True
    )
    for name, gradient in zip(inputs, gradients, strict=True):
        require(gradient is not None, f"{name} receives no gradient")
        good = gradient is not None and gradient.isfinite().all()
        require(good, f"the gradient of {name} is not finite")


def projected_values_stay_projected(make: Make[Exposure]) -> None:
    """A projection keeps names and shapes and does not change its input.

    A second projection changes nothing.
    """
    exposure = make()
    values = {name: tensor + _noise(tensor) for name, tensor in _starts(exposure).items()}
    if not values:
        raise cannot_tell("it has no parameters")
    kept = {name: tensor.clone() for name, tensor in values.items()}
    once = exposure.project(values)
    require(once.keys() == values.keys(), f"the parameters {sorted(values)} became {sorted(once)}")
    for name, tensor in once.items():
        _require_rows(f"the projected {name}", tensor)
        require(torch.equal(values[name], kept[name]), f"the projection changes {name} in place")
        again = exposure.project(once)[name]
        close = torch.allclose(again, tensor, rtol=_ROUNDING, atol=_ROUNDING)
        require(close, f"a second projection changes {name} again")


def a_view_that_was_not_seen_has_values(make: Make[Exposure]) -> None:
    """Held-out views get finite parameters.

    The parameters of held-out views have the shapes of the parameters of training photos.
    """
    exposure, scene = make(), sample_scene()
    starts = _starts(exposure)
    for view in scene.test_views:
        values = exposure.predict_unseen(view, scene, starts)
        require(values.keys() == starts.keys(), f"a held-out view receives {sorted(values)}")
        for name, value in values.items():
            right = value.shape == starts[name].shape[1:] and value.isfinite().all()
            require(right, f"a held-out view's {name} is {value!r}")


def same_input_same_bits(make: Make[Exposure]) -> None:
    """The exposed image depends only on the render and the parameters."""
    values = _first(_starts(make()))
    one, two = (make().apply(_image(), values) for _ in range(2))
    require(torch.equal(one, two), "two calls return different images")


def _starts(exposure: Exposure) -> dict[str, Tensor]:
    return {
        name: parameter.first() for name, parameter in exposure.per_photo(sample_scene()).items()
    }


def _first(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: rows[0] for name, rows in values.items()}


def _require_rows(what: str, value: Tensor) -> None:
    photos = len(sample_scene().train_views)
    right = value.ndim > 0 and value.shape[0] == photos and value.dtype == torch.float32
    description = f"{value.dtype} of shape {list(value.shape)}"
    require(
        right, f"{what} is {description}; expected float32 with {photos} rows, one for each photo"
    )
    require(value.isfinite().all(), f"{what} is not finite")


def _image() -> Tensor:
    return torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(6))


def _noise(like: Tensor) -> Tensor:
    return 0.1 * torch.randn(like.shape, generator=torch.Generator().manual_seed(7))


EXPOSURE_CHECKS: tuple[Check[Exposure], ...] = (
    *COMPONENT_CHECKS,
    fitting_gives_an_installed_one,
    every_photo_has_a_start,
    an_image_stays_an_image,
    gradients_reach_render_and_values,
    projected_values_stay_projected,
    a_view_that_was_not_seen_has_values,
    same_input_same_bits,
)
