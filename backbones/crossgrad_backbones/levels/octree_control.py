"""Growing and pruning of anchors by level of detail (Octree-GS, Ren et al. 2024)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.growth.anchor_base import AnchorDensifier
from crossgrad_backbones.anchors.growth.new_anchors import GrowthRequest, NewAnchors
from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_backbones.levels.octree_growing import Thresholds, grown, seen_from_farther
from crossgrad_core.plugin import SHORTEST_ANCHOR_INTERVAL, DensifyContext, Parameters, Schedule

#: The published schedule is one of 40,000 steps: anchors grow after 1500 and before 25,000 of them.
_LENGTH, _FROM, _UNTIL, _EVERY = 40_000, 1500, 25_000, 100


class OctreeControl(AnchorDensifier):
    """Adds anchors of the own level or, at larger gradients, of the next one.

    Pruning is that of Scaffold-GS; no candidate is dropped at random. Anchors whose offsets have
    large gradients on average are seen from a little farther away from then on. Where this differs
    from the published code:

    - An offset of the last level grows there whatever its gradient; the code grows nothing where it
      exceeds the threshold of a level that does not exist.
    - Each anchor is tested once per edit for its extra level, against the threshold of its own
      level; the code tests all anchors against the threshold of every level in turn, and adds up.
    - The next level takes anchors even if it holds none yet; in the code it stays empty.
    - A cell that both levels ask for in one edit takes the features of its own level.

    As in the code, and unlike its evident intention, next levels and extra levels grow from the
    first edit on, not after the coarse phase.
    """

    tensors: ClassVar[frozenset[str]] = AnchorDensifier.tensors | {
        "levels",
        "extra_levels",
        "lattice",
    }

    update_ratio: float = Field(
        0.2, ge=0, description="thresholds grow by fork^update_ratio per level"
    )
    extra_ratio: float = Field(
        0.25, ge=0, description="an anchor's mean gradient for an extra level, thresholds"
    )
    extra_level: float = Field(0.01, ge=0, description="what is added to an extra level, levels")

    @override
    def window(self, schedule: Schedule) -> Schedule:
        length = _LENGTH if schedule.published else schedule.length
        edited = schedule.with_edits(
            start=length * _FROM // _LENGTH,
            until=length * _UNTIL // _LENGTH,
            every=max(SHORTEST_ANCHOR_INTERVAL, length * _EVERY // _LENGTH),
        )
        return replace(
            edited,
            lr_until=length,
            coarse_until=min(length // 4, schedule.counted(schedule.total) // 2),
            reset_every=None,
        )

    @override
    def grown(
        self, context: DensifyContext, parameters: Parameters, request: GrowthRequest
    ) -> NewAnchors:
        centers = torch.from_numpy(context.scene.centers)
        return grown(parameters, request, self._thresholds(parameters), centers)

    @override
    def changed(self, parameters: Parameters, request: GrowthRequest) -> Mapping[str, Tensor]:
        thresholds = self._thresholds(parameters, self.extra_ratio)
        farther = seen_from_farther(parameters, request, thresholds)
        extra = parameters["extra_levels"] + self.extra_level * farther
        return {**super().changed(parameters, request), "extra_levels": extra}

    def _thresholds(self, parameters: Parameters, share: float = 1.0) -> Thresholds:
        """The thresholds of all levels, times `share`."""
        fork = float(Lattice.of(parameters["lattice"]).fork)
        return Thresholds(share * self.grad_threshold, fork**self.update_ratio)
