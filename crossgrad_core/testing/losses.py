"""Contract checks for losses."""

import torch
from torch import Tensor

from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, Make, require

_HEIGHT, _WIDTH = 24, 32
#: Relative difference between float32 sums with a different order of summation.
_ROUNDING = 1e-5


def is_a_finite_scalar_with_a_gradient(make: Make[Loss]) -> None:
    """The loss is one finite number.

    The gradient with respect to the render is finite and not zero.
    """
    for mask, weights in ((None, None), (_mask(), None), (None, _weights()), (_mask(), _weights())):
        value, gradient = _taken(make(), _render(), mask, weights)
        require(
            value.shape == (),
            f"the loss has the shape {list(value.shape)}, not the shape of a scalar",
        )
        require(value.isfinite(), f"the loss is {value.item()}")
        require(gradient.isfinite().all(), "the gradient with respect to the render is not finite")
        require(gradient.any(), "the render receives no gradient from a photo that differs from it")


def is_smallest_where_render_and_photo_agree(make: Make[Loss]) -> None:
    """A render that equals the photo has a smaller loss than any other tested render."""
    loss, same = make(), _photo().float() / 255
    best = loss.loss(same, _photo(), None, None)
    other = loss.loss(_render(), _photo(), None, None)
    require(best < other, f"a perfect render has the loss {best.item()}, a bad one {other.item()}")


def masked_pixels_do_not_count(make: Make[Loss]) -> None:
    """Pixels for which the mask is False do not change the loss, and their gradient is 0."""
    loss, mask = make(), _mask()
    value, gradient = _taken(loss, _render(), mask, None)
    require(not gradient[~mask].any(), "the render receives a gradient where the mask is False")
    changed = torch.where(mask[..., None], _render(), torch.full_like(_render(), 0.9))
    again = loss.loss(changed, _photo(), mask, None)
    require(torch.equal(value, again), "masked pixels change the loss")


def nothing_that_counts_is_no_loss(make: Make[Loss]) -> None:
    """If all pixels are masked or have weight 0, the loss and its gradient are 0."""
    nothing = torch.zeros(_HEIGHT, _WIDTH)
    for mask, weights in ((nothing.bool(), None), (None, nothing)):
        value, gradient = _taken(make(), _render(), mask, weights)
        what = "weight" if mask is None else "mask"
        require(value == 0, f"without an unmasked pixel ({what}) the loss is {value.item()}")
        require(not gradient.any(), f"without an unmasked pixel ({what}) there is a gradient")


def equal_weights_change_nothing(make: Make[Loss]) -> None:
    """If all pixels have equal weights, the loss equals the loss without weights."""
    loss = make()
    plain = loss.loss(_render(), _photo(), _mask(), None)
    for level in (1.0, 0.25):
        equal = loss.loss(_render(), _photo(), _mask(), torch.full((_HEIGHT, _WIDTH), level))
        close = torch.isclose(plain, equal, rtol=_ROUNDING)
        require(
            close, f"the loss is {plain.item()}, but with all weights {level} it is {equal.item()}"
        )


def weights_count(make: Make[Loss]) -> None:
    """Pixels with weight 0 receive smaller gradients than pixels with weight 1."""
    left = torch.zeros(_HEIGHT, _WIDTH)
    left[:, : _WIDTH // 2] = 1.0
    _, gradient = _taken(make(), _render(), None, left)
    sides = gradient.abs().sum(dim=(0, 2)).chunk(2)
    require(sides[0].sum() > sides[1].sum(), "pixel weights do not change the gradient")


def same_input_same_bits(make: Make[Loss]) -> None:
    """The loss depends only on its arguments, and does not change its arguments."""
    render, photo, mask, weights = _render(), _photo(), _mask(), _weights()
    first = make().loss(render, photo, mask, weights)
    require(torch.equal(first, make().loss(render, photo, mask, weights)), "two calls differ")
    kept = (_render(), _photo(), _mask(), _weights())
    for one, other in zip((render, photo, mask, weights), kept, strict=True):
        require(torch.equal(one, other), "the loss changes its arguments")


def _taken(
    loss: Loss, render: Tensor, mask: Tensor | None, weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the loss and its gradient with respect to the render."""
    leaf = render.clone().requires_grad_()
    value = loss.loss(leaf, _photo(), mask, weights)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach(), gradient


def _render() -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(_HEIGHT, _WIDTH, 3, generator=generator) * 0.5


def _photo() -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randint(128, 256, (_HEIGHT, _WIDTH, 3), generator=generator, dtype=torch.uint8)


def _mask() -> Tensor:
    mask = torch.ones(_HEIGHT, _WIDTH, dtype=torch.bool)
    mask[3:9, 5:20] = False
    return mask


def _weights() -> Tensor:
    return torch.rand(_HEIGHT, _WIDTH, generator=torch.Generator().manual_seed(3))


LOSS_CHECKS: tuple[Check[Loss], ...] = (
    *COMPONENT_CHECKS,
    is_a_finite_scalar_with_a_gradient,
    is_smallest_where_render_and_photo_agree,
    masked_pixels_do_not_count,
    nothing_that_counts_is_no_loss,
    equal_weights_change_nothing,
    weights_count,
    same_input_same_bits,
)
