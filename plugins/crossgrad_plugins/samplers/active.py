"""Active pairs: a view, and a partner from the other group with a very different loss."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import ClassVar, cast

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    Json,
    PluginState,
    SampleContext,
    Sampler,
    StepRecord,
    ViewCounts,
    ViewSample,
    octave,
)
from crossgrad_plugins.samplers.draws import drawn, groups_of, training_views

_SMALLEST_TEMPERATURE = 1e-8


class Active(Sampler):
    """A uniform view, and a view of the other group chosen by the difference in running loss.

    The partner is drawn from the `top` views of the other group with the largest |loss - loss of
    the first view|. The draw is a softmax whose temperature is the standard deviation of these
    differences. Losses are running means per view. A running mean starts again when the octave of
    the view's scale changes. Views that were never rendered have no running loss; they are drawn
    first, as first view or as partner.

    Source: the paper, active loss-disparity pairing. The values of top, temperature and decay were
    chosen for crossgrad, because the paper does not give them.
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "radial"
    groups: ClassVar[int | None] = 2

    top: int = Field(
        8, ge=1, description="number of candidate partners; all views of a smaller group"
    )
    decay: float = Field(0.9, ge=0.0, lt=1.0, description="decay of a view's running loss")

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        losses, octaves = self._running_losses(context.last, state)
        groups = groups_of(context, "active", 2)
        views = training_views(context)
        first = _uniform(_never_rendered(views, losses) or views, context.rng)
        others = next(pool for pool in groups.values() if first not in pool)
        second = self._partner(first, others, losses, context.rng)
        values: dict[str, Json] = {"losses": cast("dict[str, Json]", losses)}
        if octaves:
            values["octaves"] = cast("dict[str, Json]", octaves)
        return drawn((first, second), context), PluginState(values)

    def _running_losses(
        self, last: StepRecord | None, state: PluginState
    ) -> tuple[dict[str, float], dict[str, int]]:
        """Return the running loss and the octave of each view (its index as text, for JSON).

        The losses include the last completed step. A view's running loss starts again when the view
        is rendered at another octave of scale. Views at full size have no entry in the octaves.
        """
        losses = dict(cast("Mapping[str, float]", state.values.get("losses", {})))
        octaves = dict(cast("Mapping[str, int]", state.values.get("octaves", {})))
        if last is None:
            return losses, octaves
        scales = last.scales or (1.0,) * len(last.views)
        for index, loss, scale in zip(last.views, last.losses, scales, strict=True):
            if not isfinite(loss):
                continue
            view, level = str(index), octave(scale)
            old = losses.get(view, loss) if octaves.pop(view, 0) == level else loss
            losses[view] = self.decay * old + (1.0 - self.decay) * loss
            if level:
                octaves[view] = level
        return losses, octaves

    def _partner(
        self,
        first: int,
        others: Sequence[int],
        losses: Mapping[str, float],
        rng: np.random.Generator,
    ) -> int:
        """Return the second view.

        A view that was never rendered is preferred. Without such a view, the loss difference
        decides.
        """
        fresh = _never_rendered(others, losses)
        if fresh or str(first) not in losses:
            return _uniform(fresh or others, rng)
        scores = np.abs(np.array([losses[str(view)] for view in others]) - losses[str(first)])
        # Use a stable sort, so that views with equal scores keep their order.
        best = np.argsort(-scores, kind="stable")[: self.top]
        temperature = max(float(scores[best].std()), _SMALLEST_TEMPERATURE)
        logits = (scores[best] - scores[best].max()) / temperature
        weights = np.exp(logits)
        return others[int(rng.choice(best, p=weights / weights.sum()))]


def _never_rendered(pool: Sequence[int], losses: Mapping[str, float]) -> list[int]:
    """Return the views of the pool without a running loss."""
    return [view for view in pool if str(view) not in losses]


def _uniform(pool: Sequence[int], rng: np.random.Generator) -> int:
    return int(pool[int(rng.integers(len(pool)))])
