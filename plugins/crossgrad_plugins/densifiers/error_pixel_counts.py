"""Counts of the erroneous pixels of each primitive, over several views (FastGS)."""

from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from crossgrad_core.plugin import (
    Densifier,
    DensifyContext,
    PluginState,
    RenderedView,
    View,
    screen_statistics,
    unit_range,
)

#: Names of the sums per primitive and regime [P, R]: erroneous pixels, erroneous pixels times the
#: view's loss, and renders that showed the primitive.
MARKED, ERROR, VISITS = "marked", "error", "visits"
#: Number of rendered views of each regime.
DRAWN = "drawn"
#: The rank of a primitive divides its sum by this power of the number of renders. Power 0 ranks by
#: the sum, and power 1 ranks by the mean.
VISITS_POWER = 0.75


@dataclass(frozen=True)
class MultiViewScore:
    """The importance of P primitives in several views, per regime.

    Attributes:
        marked: [P, R] number of erroneous pixels of the full photo, mean over views.
        error: [P, R] number of erroneous pixels times the view's loss, mean over views.
        rank: [P, R] value by which the primitives of a regime are ranked.
    """

    marked: Tensor
    error: Tensor
    rank: Tensor

    def above(self, threshold: float) -> Tensor:
        """Return [P, R], True if the rounded-down number of pixels is above a threshold."""
        return self.marked.floor() > threshold

    def strength(self, grows: Tensor) -> Tensor:
        """Return [P] the priority of each growing primitive: minus its best rank in a regime.

        The regimes alternate: first the best primitive of each regime, then the second of each
        regime, and so on.

        Args:
            grows: [P, R] bool, True for primitives that grow.
        """
        ranked = torch.where(grows, self.rank, -torch.inf)
        order = ranked.argsort(dim=0, descending=True, stable=True)
        places = torch.empty_like(self.rank)
        numbers = torch.arange(len(order), device=order.device).to(places)
        places.scatter_(0, order, numbers[:, None].expand_as(places))
        return -torch.where(grows, places, torch.inf).amin(dim=1)

    @property
    def pruning_score(self) -> Tensor:
        """The error [P], scaled linearly to [0, 1]; 0 if all errors are equal."""
        error = self.error.sum(dim=1)
        if len(error) == 0:
            return error
        low, high = error.amin(), error.amax()
        return torch.where(high > low, (error - low) / (high - low), 0.0)


class CountsMarkedPixels(Densifier, ABC):
    """A densifier that counts the erroneous pixels of each primitive over several views.

    A primitive's count is the number of erroneous pixels in which it is blended. The error of a
    pixel is its absolute difference from the photo, averaged over channels. It is scaled to [0, 1]
    by the smallest and largest error of the view. A pixel is erroneous if its error is above
    `error_threshold`. At any scale of the render, counts are given in pixels of the full photo.
    """

    count: Literal["render", "running"] = Field(
        "render",
        description="views in which pixels are counted. render: some views, rendered at each "
        "edit; running: the views rendered in the steps since the last edit",
    )
    views: int = Field(
        10, ge=1, description="number of random training views rendered at each edit"
    )
    share: float = Field(
        0.25, gt=0, le=1, description="running: share of the steps whose views are counted"
    )
    regimes: bool = Field(
        False, description="count by regime, and grow if the views of any regime require it"
    )
    error_threshold: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="error above which a pixel is counted, as a share of the largest error",
    )
    importance: float = Field(
        5.0,
        ge=0,
        description="grow above this mean number of counted pixels per view; a whole number",
    )

    def counted(self, context: DensifyContext, state: PluginState) -> PluginState:
        """Return the counts after the counts of this step were added, if this step counts."""
        edits = context.schedule.densifies(context.step)
        if self.count == "render":
            return self.rendered(context) if edits else PluginState()
        sums = self._sums(context, state)
        if edits or context.rng.random() < self.share:
            for record in context.views:
                self._add(context, record, record.loss, sums)
        return PluginState(per_primitive=sums)

    @torch.no_grad()
    def rendered(self, context: DensifyContext) -> PluginState:
        """Return the counts of `views` training views, rendered at the scale of the step."""
        last = context.views[-1] if context.views else None
        scale, background = (last.scale, last.background) if last else (1.0, None)
        columns = [self._column(context, view) for view in context.scene.train_views]
        drawn = drawn_views(columns, self.views, context.rng)
        sums = self._sums(context, PluginState())
        for index in drawn:
            view = context.render(index, scale, frozenset({"count"}), background)
            self._add(context, view, float(view.loss), sums)
        numbers = np.bincount([columns[index] for index in drawn], minlength=max(columns) + 1)
        return PluginState({DRAWN: numbers.tolist()}, per_primitive=sums)

    def importance_of(self, state: PluginState) -> MultiViewScore:
        """Return the score that follows from the counts of a state.

        Normally, the mean is taken over the views that were rendered for counting. With `count:
        running`, the mean is taken over the training renders that showed the primitive.
        """
        marked, error, visits = (state.per_primitive[name] for name in (MARKED, ERROR, VISITS))
        drawn = state.values.get(DRAWN)
        per = (visits if drawn is None else torch.tensor(drawn).to(visits)).clamp(min=1.0)
        rank = error / visits.clamp(min=1.0).pow(VISITS_POWER)
        return MultiViewScore(marked / per, error / per, rank)

    def idle_counting(self, *, renders: bool) -> dict[str, str]:
        """Return the counting options that have no effect, and the reasons.

        Args:
            renders: True if views are rendered for counting even with `count: running`.
        """
        if self.count == "render":
            return {"share": "count render selects its own views; leave the option out"}
        why = "count running renders no extra views; leave the option out"
        return {} if renders else {"views": why}

    def _sums(self, context: DensifyContext, state: PluginState) -> dict[str, Tensor]:
        """Return copies of the sums [P, R], or zeros if the state has no sums."""
        blocks, have = context.backbone.blocks(), state.per_primitive
        name = next(block.tensors[0] for block in blocks if block.per_primitive)
        like = context.parameters[name].detach()
        zeros = like.new_zeros(like.shape[0], len(self._regimes(context)))
        return {key: have.get(key, zeros).clone() for key in (MARKED, ERROR, VISITS)}

    def _regimes(self, context: DensifyContext) -> list[str]:
        """Return the regimes whose pixels are counted separately."""
        names = {view.regime for view in context.scene.train_views} if self.regimes else {""}
        return sorted(names)

    def _column(self, context: DensifyContext, view: View) -> int:
        return self._regimes(context).index(view.regime) if self.regimes else 0

    def _add(
        self, context: DensifyContext, view: RenderedView, loss: float, sums: dict[str, Tensor]
    ) -> None:
        """Add the counts of a view to the sums in place."""
        if view.screen.count is None:
            raise RuntimeError(
                "the rasterizer returned no pixel counts, although they were requested"
            )
        column = self._column(context, view.view)
        counts = view.screen.count(erroneous(view, self.error_threshold))
        marked, shown = (torch.zeros_like(sums[MARKED][:, 0]) for _ in range(2))
        screen_statistics.add(view, marked, screen_statistics.of_photo(view, counts))
        screen_statistics.add(view, shown, screen_statistics.visible(view))
        sums[MARKED][:, column] += marked
        sums[ERROR][:, column] += marked * loss
        sums[VISITS][:, column] += shown > 0


def erroneous(view: RenderedView, threshold: float) -> Tensor:
    """Return [H, W], True for pixels whose error, scaled to the view's range, is too large.

    The error is the absolute difference from the photo, averaged over channels. Masked pixels are
    never erroneous. If all pixels have the same error, no pixel is erroneous.
    """
    photo = unit_range(view.photo, view.image.dtype)
    red, green, blue = (view.image - photo).abs().unbind(-1)
    error = (red + green + blue) / 3.0
    least, most = error, error
    if view.mask is not None:
        least = torch.where(view.mask, error, torch.inf)
        most = torch.where(view.mask, error, -torch.inf)
    low, high = least.amin(), most.amax()
    marked = (error - low) > threshold * (high - low)
    return marked if view.mask is None else marked & view.mask


def drawn_views(columns: Sequence[int], number: int, rng: np.random.Generator) -> list[int]:
    """Return random different views: equally many from all groups, at least one from each.

    Args:
        columns: Index of the group of each view.
        number: Number of views to draw.
        rng: Random generator.
    """
    groups = max(columns) + 1
    drawn = []
    for group in range(groups):
        members = np.flatnonzero(np.asarray(columns) == group)
        wanted = max(1, number // groups + (group < number % groups))
        drawn += rng.choice(members, min(wanted, len(members)), replace=False).tolist()
    return drawn
