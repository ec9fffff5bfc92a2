"""Updates of SH bands in only some of the steps, to save time (docs/schedules.md)."""

from collections.abc import Mapping

from typing_extensions import override

from crossgrad_core.plugin import Backbone, Block, Field, Rule, Scene, hookimpl


class SparseSh(Rule):
    """Updates SH bands above the first only in every n-th step."""

    every: int = Field(
        2, ge=2, le=100, description="number of steps per update of the SH bands above the first"
    )

    @hookimpl
    def crossgrad_update_intervals(self, blocks: tuple[Block, ...]) -> Mapping[str, int]:
        """Return the update interval of every tensor that is not updated in each step."""
        return {name: self.every for block in blocks if block.rests for name in block.tensors}

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        banded = any(block.rests for block in backbone.trained_blocks())
        return "" if banded else "the backbone trains no SH bands above the first"
