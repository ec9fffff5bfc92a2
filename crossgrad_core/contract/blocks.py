"""Parameters of a backbone and the named blocks that operators and the optimizer work on."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, inf, log
from typing import Literal, TypeAlias, get_args

from torch import Tensor

BlockKind = Literal["geometry", "appearance", "neutral"]

#: Tensor name -> leaf tensor. Per-primitive tensors have the primitives as first dimension.
Parameters: TypeAlias = dict[str, Tensor]


@dataclass(frozen=True)
class LearningRate:
    """A log-linear learning rate from `initial` to `final` over the schedule's length; 0 stays 0.

    Attributes:
        initial: At the first step.
        final: At the end of the schedule; None: `initial`.
        hurried: What it is multiplied by, beside all others of the backbone, in a run that shows
            each photo a few times (docs/schedules.md); positive.

    Source: 3DGS; lr(t) = exp((1-u) ln a + u ln b), u = clip(t / T, 0, 1).
    """

    initial: float
    final: float | None = None
    hurried: float = 1.0

    def __post_init__(self) -> None:
        """Refuses rates that no schedule can follow.

        Raises:
            ValueError: A rate is negative or not finite, or fades to 0, which no logarithm has; or
                `hurried` is no positive number.
        """
        rates = [rate for rate in (self.initial, self.final) if rate is not None]
        if not all(0.0 <= rate < inf for rate in rates):
            raise ValueError(f"learning rates are finite and not negative; found {rates}")
        if self.initial > 0.0 and self.final == 0.0:
            raise ValueError("a learning rate cannot fade to 0 log-linearly; name a small one")
        if not 0.0 < self.hurried < inf:
            raise ValueError(f"`hurried` is a positive number; found {self.hurried}")

    @property
    def decays(self) -> bool:
        """Whether the rate changes over the schedule."""
        return self.final is not None and self.initial not in {0.0, self.final}

    def at(self, progress: float) -> float:
        """The rate when a share `progress` of the schedule is over (clipped to [0, 1])."""
        if self.final is None or not self.decays:
            return self.initial
        u = min(max(progress, 0.0), 1.0)
        return exp((1.0 - u) * log(self.initial) + u * log(self.final))


@dataclass(frozen=True)
class Block:
    """A group of tensors that is aggregated as one vector and shares one learning rate.

    Attributes:
        name: Name of the block.
        tensors: Names of its tensors in `Parameters`; a single-tensor block carries its name.
        per_primitive: Whether the first dimension of every tensor counts primitives.
        kind: Geometry, appearance or neutral (for granularity `kind` and per-block dispatch).
        lr: Learning rate of all its tensors; 0 freezes the block: its tensors get no gradient,
            may be of any type, and take part in topology edits and checkpoints only.
        rests: Whether its tensors are details of the colour, such as spherical harmonics of higher
            degrees, that need not learn in every step (`Schedule.sh_every`).
    """

    name: str
    tensors: tuple[str, ...]
    per_primitive: bool
    kind: BlockKind
    lr: LearningRate
    rests: bool = False

    def __post_init__(self) -> None:
        """Refuses what only later would go wrong.

        Raises:
            ValueError: The kind is none.
            TypeError: The names of the tensors are no tuple, or the rate is a bare number.
        """
        if self.kind not in get_args(BlockKind):
            kinds = get_args(BlockKind)
            raise ValueError(f"block {self.name}: the kind {self.kind!r} is none of {kinds}")
        if not isinstance(self.tensors, tuple) or not isinstance(self.lr, LearningRate):
            raise TypeError(f"block {self.name}: tensors is a tuple of names, lr a LearningRate")

    @property
    def frozen(self) -> bool:
        """Whether training leaves the block as it is."""
        return self.lr.initial == 0.0


def primitives_of(blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]) -> int:
    """The number of primitives, read off the first per-primitive tensor."""
    for block in blocks:
        if block.per_primitive:
            return int(parameters[block.tensors[0]].shape[0])
    return 0
