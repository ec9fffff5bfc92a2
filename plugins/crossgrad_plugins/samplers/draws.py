"""Draws of views from a pool or a group: independent, without repetition, or epoch by epoch."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, cast

import numpy as np

from crossgrad_core.plugin import Json, SampleContext, UserError, ViewSample

Order = Literal["iid", "distinct", "epoch"]


@dataclass(frozen=True)
class EpochOrder:
    """The state of an epoch: a shuffled pool, and the number of views that were drawn from it.

    Attributes:
        order: The views of the pool, in the order of this epoch.
        drawn_views: Number of views of `order` that have been drawn.
    """

    order: Sequence[int] = ()
    drawn_views: int = 0

    def next(
        self, count: int, renew: Callable[[], Sequence[int]]
    ) -> tuple[list[int], "EpochOrder"]:
        """Return the next `count` views and the new state; every view occurs once per epoch.

        If the epoch ends within a draw, the next epoch begins with views that this draw does not
        yet contain. A draw therefore never contains a view twice.

        Args:
            count: Number of views to draw, at most the size of the pool.
            renew: Function that returns the order of a new epoch.
        """
        drawn = list(self.order[self.drawn_views : self.drawn_views + count])
        missing = count - len(drawn)
        if missing == 0:
            return drawn, EpochOrder(self.order, self.drawn_views + count)
        order, held = renew(), set(drawn)
        fresh = [view for view in order if view not in held][:missing]
        taken = set(fresh)
        rest = [view for view in order if view not in taken]
        return drawn + fresh, EpochOrder(fresh + rest, missing)

    def to_json(self) -> dict[str, Json]:
        """Return the state as plain data for JSON.

        The list `order` is not copied, because it never changes.
        """
        return {"order": cast("list[Json]", self.order), "dealt": self.drawn_views}

    @staticmethod
    def from_json(data: Json) -> "EpochOrder":
        """Return the state that `to_json` wrote; for None, return a new state."""
        if data is None:
            return EpochOrder()
        values = cast("dict[str, Json]", data)
        return EpochOrder(cast("list[int]", values["order"]), cast("int", values["dealt"]))


def draw(
    pool: Sequence[int], count: int, order: Order, epoch_order: EpochOrder, rng: np.random.Generator
) -> tuple[list[int], EpochOrder]:
    """Draw `count` members of `pool`, and return them with the state of the epoch after the draw.

    Raises:
        UserError: A draw without repetition needs more members than the pool has.
    """
    if order == "iid":
        return [int(pool[i]) for i in rng.integers(len(pool), size=count)], epoch_order
    require_enough(len(pool), count)
    if order == "distinct":
        chosen = rng.choice(len(pool), size=count, replace=False)
        return [int(pool[i]) for i in chosen], epoch_order
    return epoch_order.next(count, lambda: [int(view) for view in rng.permutation(pool)])


def require_enough(available: int, count: int) -> None:
    """Raise an error if a draw needs more different views than the pool has.

    Raises:
        UserError: `count` is larger than `available`.
    """
    if count > available:
        raise UserError(
            f"a step needs {count} different views, but only {available} training views "
            "are available",
            where="sampler",
            expected=f"at most {available} views per step from this group of training views",
            todo="lower --views, or choose sampler random, which can draw a view more than once",
        )


def training_views(context: SampleContext) -> range:
    """Return the indices of all training views.

    Raises:
        UserError: There are no training views.
    """
    if len(context.centers) == 0:
        raise UserError(
            "the scene has no training views",
            where=context.scene.name,
            todo="check the split: --split none trains on all images",
        )
    return range(len(context.centers))


def members_of(context: SampleContext) -> Mapping[str, tuple[int, ...]]:
    """Return the indices of the training views of each label; `near` is first and `far` is last."""
    return _members(context.groups or ())


def groups_of(context: SampleContext, sampler: str, expected: int) -> Mapping[str, tuple[int, ...]]:
    """Return the groups of `members_of` after a check of their number.

    Args:
        context: The context of the step.
        sampler: Name of the calling sampler, for the message.
        expected: Number of groups that the sampler needs.

    Raises:
        UserError: There is no grouping, or the number of its groups is not `expected`.
    """
    groups = members_of(context)
    if len(groups) != expected:
        raise UserError(
            f"sampler {sampler} needs {expected} groups of training views",
            where="sampler, grouping",
            expected=f"{expected} labels",
            found=", ".join(groups) if groups else "no grouping",
            todo="choose a grouping with --grouping; `crossgrad plugins list` names them",
        )
    return groups


def drawn(views: Sequence[int], context: SampleContext) -> ViewSample:
    """Return the sample with `views`, and with their labels if there is a grouping."""
    groups = context.groups
    labels = None if groups is None else tuple(groups[view] for view in views)
    return ViewSample(tuple(views), labels)


@lru_cache(maxsize=8)
def _members(labels: tuple[str, ...]) -> Mapping[str, tuple[int, ...]]:
    names = sorted(set(labels), key=lambda label: (_rank(label), label))
    return {name: tuple(i for i, label in enumerate(labels) if label == name) for name in names}


def _rank(label: str) -> int:
    """Return the sort key of a label: 0 for near, 2 for far, 1 for any other label."""
    return {"near": 0, "far": 2}.get(label, 1)
