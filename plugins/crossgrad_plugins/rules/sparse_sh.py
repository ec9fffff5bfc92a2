"""SH bands that learn in some steps only, which saves time (docs/schedules.md)."""

from collections.abc import Mapping

from typing_extensions import override

from crossgrad_core.plugin import Backbone, Block, Field, Rule, Scene, hookimpl


class SparseSh(Rule):
    """Lets SH bands above the first learn in one of several steps."""

    every: int = Field(2, ge=2, le=100, description="SH bands learn in one of so many steps")

    @hookimpl
    def crossgrad_update_intervals(self, blocks: tuple[Block, ...]) -> Mapping[str, int]:
        """Name the tensors of all blocks that need not learn in every step."""
        return {name: self.every for block in blocks if block.rests for name in block.tensors}

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        banded = any(block.rests for block in backbone.trained_blocks())
        return "" if banded else "the backbone trains no SH bands above the first"
