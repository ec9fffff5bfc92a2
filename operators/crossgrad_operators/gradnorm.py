"""GradNorm (Chen et al. 2018), with groups of views instead of tasks."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GramianOperator,
    Json,
    OperatorContext,
    PluginState,
    Selection,
    diagonals,
    hookimpl,
    octave,
)
from crossgrad_operators._labels import label_objections, labels_of
from crossgrad_operators._memory import recall, remember

#: Name of a group -> number, initial value and average of the losses of its views. Losses at image
#: scales below full size are stored separately for each octave of the scale.
_Losses = dict[str, dict[str, Any]]


class GradNorm(GramianOperator):
    """Weight groups of views such that the gradient norm of each group follows its relative loss.

    The target for G_s = w_s |g_s| of group s is mean(G) (l_s / mean l)^alpha. Here l_s is the
    average loss of the group divided by its initial loss. In each step, log w_s moves by a fixed
    amount towards the target. The weights are scaled such that their sum over the groups with a
    gradient equals the number of these groups. Each block and group has one weight, which applies
    to all views of the group. Losses are stored separately for each octave of the image scale.
    """

    identity_at_one: ClassVar[bool] = True
    default_grouping: ClassVar[str | None] = "radial"
    alpha: float = Field(1.5, ge=0, description="exponent that increases the weight of slow groups")
    lr: float = Field(0.025, gt=0, description="learning rate of log w")
    baseline: int = Field(
        50, ge=1, description="number of losses that define a group's initial loss"
    )
    decay: float = Field(0.99, ge=0, lt=1, description="decay of the average loss per view")

    @override
    def reads_labels(self) -> bool:
        return True

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        if self.alpha > 0:
            return {}
        return dict.fromkeys(
            ("baseline", "decay"), "alpha = 0 uses no losses; leave the option out"
        )

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        from crossgrad_operators.numba_kernels.gates import follow_losses

        labels = labels_of(context, "gradnorm")
        losses = self._followed(cast("_Losses", state.values.get("losses", {})), labels, context)
        groups = list(losses)
        group = np.array([groups.index(label) for label in labels])
        logs = recall(state, context, "log_weight", (len(groups),))
        weights = follow_losses(logs, gramians, group, self._rates(losses), self.alpha, self.lr)
        values = {**state.values, "losses": cast("Json", losses)}
        kept = PluginState(values, state.tensors, state.per_primitive)
        return diagonals(weights), remember(kept, context, "log_weight", logs)

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return objections to samplers whose views have no labels."""
        return label_objections(selection)

    def _followed(
        self, losses: _Losses, labels: tuple[str, ...], context: OperatorContext
    ) -> _Losses:
        """Return the stored losses of all groups, updated with the losses of this step."""
        followed = deepcopy(losses)
        scales = context.scales or (1.0,) * len(labels)
        for label, loss, scale in zip(labels, context.losses.tolist(), scales, strict=True):
            seen = _at(followed.setdefault(label, _fresh(loss)), octave(scale), loss)
            seen["count"] += 1
            if seen["count"] <= self.baseline:
                seen["start"] += (loss - seen["start"]) / seen["count"]
            seen["average"] += (1 - self.decay) * (loss - seen["average"])
        return followed

    def _rates(self, losses: _Losses) -> NDArray[np.float64]:
        """Return the relative loss l_s of each of the S groups [S].

        Return only ones until every group has an initial loss.
        """
        newest = [_at(group, group.get("octave", 0), 0.0) for group in losses.values()]
        have_started = all(s["count"] >= self.baseline and s["start"] > 0 for s in newest)
        if not have_started:
            return np.ones(len(losses))
        return np.array([s["average"] / s["start"] for s in newest])


def _fresh(loss: float) -> dict[str, Any]:
    return {"count": 0, "start": 0.0, "average": loss}


def _at(group: dict[str, Any], level: int, loss: float) -> dict[str, Any]:
    """Return the stored losses of a group at an octave. Record this octave as the newest octave.

    Losses at full size are stored directly in the entry of the group.
    """
    if level == 0:
        group.pop("octave", None)
        return group
    group["octave"] = level
    octave_losses: dict[str, Any] = group.setdefault("octaves", {}).setdefault(
        str(level), _fresh(loss)
    )
    return octave_losses
