"""GradDrop (Chen et al. 2020, "Just pick a sign")."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import AggregateContext, AggregateResult, Operator, PluginState


class GradDrop(Operator):
    """In each element, keep at random either the positive or the negative gradients.

    The result is the sum of the kept gradients.

    Let p be the sum of the positive values, and n the sum of the magnitudes of the negative values.
    With probability p / (p + n), the operator keeps the positive gradients, and otherwise the
    negative gradients. All views share one uniform random number for each element. The expected
    value of the result is the result of `sum`.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        gradients = context.separate
        finite, present = gradients.finite(), gradients.present()
        seed = int(context.rng.integers(2**63))
        generators: dict[torch.device, torch.Generator] = {}

        def drop(_name: str, views: Sequence[Tensor | None]) -> Tensor | None:
            given = [g for g in views if g is not None]
            if not given:
                return None
            device = given[0].device
            if device not in generators:
                generators[device] = torch.Generator(device).manual_seed(seed)
            return _one_sign(given, generators[device])

        counts = {
            "zero": int((finite & ~present).any(axis=1).sum()),
            "dropped": int((~finite).any(axis=1).sum()),
        }
        return AggregateResult(gradients.elementwise(drop), counts), state


def _one_sign(views: Sequence[Tensor], generator: torch.Generator) -> Tensor:
    """For each element, return the sum of the positive values or the sum of the negative values."""
    first = views[0]
    dtype = torch.promote_types(first.dtype, torch.float32)
    positive = torch.zeros_like(first, dtype=dtype)
    negative = torch.zeros_like(first, dtype=dtype)
    for gradient in views:
        positive += gradient.clamp(min=0)
        negative -= gradient.clamp(max=0)
    draws = torch.rand(first.shape, generator=generator, dtype=dtype, device=first.device)
    # 1 / (1 + n / p) equals p / (p + n), but cannot overflow. For 0 / 0, the comparison is False,
    # and the result is zero.
    keep = draws < 1 / (1 + negative / positive)
    return torch.where(keep, positive, -negative).to(first.dtype)
