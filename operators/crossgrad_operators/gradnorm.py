"""GradNorm (Chen et al. 2018), with groups of views in place of tasks."""

from collections.abc import Mapping
from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.component import Selection
from crossgrad_core.hooks import hookimpl
from crossgrad_core.operator import Operator, OperatorContext
from crossgrad_core.state import Json, PluginState
from crossgrad_operators._labels import label_objections, labels_of
from crossgrad_operators._memory import recall, remember
from crossgrad_operators._weights import weighting

_Losses = dict[str, dict[str, float]]


class GradNorm(Operator):
    """Weights that let gradient norms follow the relative losses: u = sum w_s g_s over groups s.

    G_s = w_s |g_s| should meet mean(G) (l_s / mean l)^alpha, where l_s is the group's average loss
    over its loss at the start. log w_s takes a step of fixed size towards that, and the weights of
    the groups with a gradient are scaled to add up to their number. One weight per block and group;
    the views of a group share it.
    """

    alpha: float = Field(1.5, ge=0, description="how strongly slow groups are favoured")
    lr: float = Field(0.025, gt=0, description="step of log w")
    baseline: int = Field(50, ge=1, description="losses that make up a group's loss at the start")
    decay: float = Field(0.99, ge=0, lt=1, description="decay of the average loss per view")

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        labels = labels_of(context, "gradnorm")
        losses = self._followed(cast("_Losses", state.values.get("losses", {})), labels, context)
        groups = tuple(losses)
        of_view = np.array([groups.index(label) for label in labels])
        members = (of_view[None, :] == np.arange(len(groups))[:, None]).astype(np.float64)
        norms = _group_norms(gramians, members)
        logs = recall(state, context, "log_weight", (len(groups),))
        weights = _scaled(logs, norms > 0)
        state = PluginState(
            {**state.values, "losses": cast("Json", losses)}, state.tensors, state.per_primitive
        )
        logs = self._stepped(weights, norms, self._rates(losses))
        state = remember(state, context, "log_weight", logs)
        return weighting(weights[:, of_view]), state

    @hookimpl
    @override
    def crossgrad_objections(self, selection: Selection) -> list[str]:
        """Refuses samplers whose views carry no labels."""
        counts = Operator.crossgrad_objections(self, selection)
        return counts + label_objections(selection)

    def _followed(
        self,
        losses: Mapping[str, Mapping[str, float]],
        labels: tuple[str, ...],
        context: OperatorContext,
    ) -> _Losses:
        """The losses of all groups so far, with those of this step."""
        followed = {label: dict(seen) for label, seen in losses.items()}
        for label, loss in zip(labels, context.losses.tolist(), strict=True):
            seen = followed.setdefault(label, {"count": 0, "start": 0.0, "average": loss})
            seen["count"] += 1
            if seen["count"] <= self.baseline:
                seen["start"] += (loss - seen["start"]) / seen["count"]
            seen["average"] += (1 - self.decay) * (loss - seen["average"])
        return followed

    def _rates(self, losses: _Losses) -> NDArray[np.float64]:
        """[S] relative losses l_s; 1 until every group has a loss at the start."""
        known = all(s["count"] >= self.baseline and s["start"] > 0 for s in losses.values())
        if not known:
            return np.ones(len(losses))
        return np.array([s["average"] / s["start"] for s in losses.values()])

    def _stepped(
        self, weights: NDArray[np.float64], norms: NDArray[np.float64], rates: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """[B, S] log weights after a step; groups without a gradient keep theirs."""
        active = norms > 0
        count = np.maximum(active.sum(axis=1, keepdims=True), 1)
        mean_rate = np.where(active, rates, 0.0).sum(axis=1, keepdims=True) / count
        relative = rates / np.where(mean_rate > 0, mean_rate, 1.0)
        # Only signs of differences matter, so that norms may be scaled to keep products finite.
        lengths = weights * norms / np.maximum(norms.max(axis=1, keepdims=True), 1e-300)
        target = lengths.sum(axis=1, keepdims=True) / count * relative**self.alpha
        logs = np.log(weights) - self.lr * np.sign(lengths - target) * (active & (count > 1))
        return np.log(_scaled(logs, active))


def _group_norms(
    gramians: NDArray[np.float64], members: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[B, S] norms of the groups' summed gradients; `members` is [S, K]."""
    squares = np.einsum("sk,bkl,sl->bs", members, gramians, members)
    norms: NDArray[np.float64] = np.sqrt(np.maximum(squares, 0.0))
    return norms


def _scaled(logs: NDArray[np.float64], active: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[B, S] weights whose active ones add up to their number."""
    limited = np.clip(logs, -230.0, 230.0)
    weights = np.exp(limited - limited.max(axis=1, keepdims=True))
    total = np.where(active, weights, 0.0).sum(axis=1, keepdims=True)
    count = active.sum(axis=1, keepdims=True)
    # Where a block has no gradient at all the weights mean nothing; they stay finite.
    factor = np.where(total > 0, count / np.where(total > 0, total, 1.0), 1.0)
    scaled: NDArray[np.float64] = weights * factor
    return scaled
