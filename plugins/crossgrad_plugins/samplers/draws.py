"""How samplers draw from a pool of views: iid, distinct or epoch by epoch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from crossgrad_core.plugin import Json, SampleContext, UserError

Order = Literal["iid", "distinct", "epoch"]


@dataclass(frozen=True)
class EpochOrder:
    """An epoch under way: a pool in the order of this epoch and how far it has been dealt.

    Attributes:
        order: The pool in the order of this epoch.
        drawn_views: How many of `order` have been drawn.
    """

    order: Sequence[int] = ()
    drawn_views: int = 0

    def next(
        self, count: int, renew: Callable[[], Sequence[int]]
    ) -> tuple[list[int], "EpochOrder"]:
        """Draws the next `count` views; every view comes once per epoch.

        Where the epoch ends within a draw the next one begins with views that this draw does not
        hold yet, so that no draw holds a view twice.

        Args:
            count: At most the size of the pool.
            renew: Gives the order of a new epoch.
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
        """The deck as plain data; the order is shared, not copied: it never changes."""
        return {"order": cast("list[Json]", self.order), "dealt": self.drawn_views}

    @staticmethod
    def from_json(data: Json) -> "EpochOrder":
        """The deck that `to_json` wrote; a new one for None."""
        if data is None:
            return EpochOrder()
        values = cast("dict[str, Json]", data)
        return EpochOrder(cast("list[int]", values["order"]), cast("int", values["dealt"]))


def draw(
    pool: Sequence[int], count: int, order: Order, epoch_order: EpochOrder, rng: np.random.Generator
) -> tuple[list[int], EpochOrder]:
    """`count` members of `pool`, and the deck of epochs afterwards.

    Raises:
        UserError: The pool holds fewer members than a draw without repetition needs.
    """
    if order == "iid":
        return [int(pool[i]) for i in rng.integers(len(pool), size=count)], epoch_order
    require_enough(len(pool), count)
    if order == "distinct":
        chosen = rng.choice(len(pool), size=count, replace=False)
        return [int(pool[i]) for i in chosen], epoch_order
    return epoch_order.next(count, lambda: [int(view) for view in rng.permutation(pool)])


def require_enough(available: int, count: int) -> None:
    """Refuses a draw of more different views than there are.

    Raises:
        UserError: `count` is larger than `available`.
    """
    if count > available:
        raise UserError(
            f"a step needs {count} different views of {available} training views",
            where="sampler",
            expected=f"at most {available} views per step from this group of training views",
            todo="lower --views, or choose sampler random, which may repeat a view",
        )


def training_views(context: SampleContext) -> range:
    """Positions of all training views.

    Raises:
        UserError: There are none.
    """
    if len(context.centers) == 0:
        raise UserError(
            "the scene has no training views",
            where=context.scene.name,
            todo="check the split: --split none trains on all images",
        )
    return range(len(context.centers))
