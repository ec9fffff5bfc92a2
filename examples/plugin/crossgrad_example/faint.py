"""A densifier that removes transparent Gaussians and adds none."""

from typing import ClassVar

import torch
from typing_extensions import override

from crossgrad_core.plugin import NO_EDIT, Densifier, DensifyContext, Edit, Field, PluginState


class Faint(Densifier):
    """A densifier that removes primitives that have become transparent."""

    tensors: ClassVar[frozenset[str]] = frozenset({"opacities"})
    resets: ClassVar[bool] = False

    threshold: float = Field(
        0.005, gt=0.0, lt=1.0, description="Gaussians with lower opacities are removed"
    )

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.densifies(context.step):
            return NO_EDIT, state
        opacities = torch.sigmoid(context.parameters["opacities"].detach()).flatten()
        kept = torch.nonzero(opacities >= self.threshold).flatten()
        if len(kept) in {0, len(opacities)}:
            return NO_EDIT, state
        return Edit(source=kept, counts={"pruned": len(opacities) - len(kept)}), state
