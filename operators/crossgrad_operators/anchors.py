"""Projection between anchor views only (arXiv 2605.00052, appendix on operator variants)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GramianOperator,
    OperatorContext,
    PluginState,
    Selection,
    ViewCounts,
    hookimpl,
)
from crossgrad_operators._labels import label_objections, labels_of
from crossgrad_operators.projection import project, slot_order


class Anchors(GramianOperator):
    """The operator `symmetric` for a near and a far anchor view, and `sum` for other pairs.

    Use this operator with the sampler `anchors-30`. The anchors of this sampler are the nearest and
    the farthest 30 % of the cameras. The gradients of the remaining cameras are added without a
    projection.
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_grouping: ClassVar[str | None] = "anchors"

    near: str = Field("near", description="label of the near anchors")
    far: str = Field("far", description="label of the far anchors")

    @override
    def reads_labels(self) -> bool:
        return True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        pair = set(labels_of(context, "anchors")) == {self.near, self.far}
        gates = np.full(gramians.shape, pair)
        return project(gramians, context, slot_order(gramians.shape[1]), gates=gates), state

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return objections to samplers whose views lack the two labels."""
        return label_objections(selection, {"near": self.near, "far": self.far})
