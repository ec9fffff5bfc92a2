"""Adam's moments and step counts, and how it averages."""

from dataclasses import dataclass, field
from math import sqrt
from typing import Final

from torch import Tensor

#: Added to the root of the second moment (3DGS).
EPS: Final = 1e-15
#: Decay of the first and of the second moment (3DGS).
BETAS: Final = (0.9, 0.999)
#: More views than this leave the first moment no memory under the batch rule.
MOST_VIEWS: Final = 10


@dataclass(frozen=True)
class AdamState:
    """Moments and step counts by tensor name; a name appears with its first gradient.

    Attributes:
        exp_avg: First moments, each shaped like its parameter.
        exp_avg_sq: Second moments, each shaped like its parameter.
        steps: How many gradients each tensor has seen.
    """

    exp_avg: dict[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: dict[str, Tensor] = field(default_factory=dict)
    steps: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class AdamRule:
    """How Adam averages.

    Attributes:
        betas: Decay of the first and the second moment, each in [0, 1).
        eps: Added to the root of the second moment.
        age: What a tensor's count of steps is multiplied by before its bias is corrected.
    """

    betas: tuple[float, float] = BETAS
    eps: float = EPS
    age: float = 1.0

    @classmethod
    def for_views(
        cls, views: int, age: float = 1.0, betas: tuple[float, float] = BETAS
    ) -> "AdamRule":
        """The batch rule: moments forget as much per view as with one view per step.

        Learning rates times sqrt(K) belong to it.

        Args:
            views: K, at most `MOST_VIEWS`.
            age: Steps of K views that draw as many as the run has, over its steps; not 1 where K
                changed.
            betas: With one view per step.

        Source: gsplat; Malladi et al. 2022 (square-root scaling), K views for K batches.
        """
        first, second = (max(0.0, 1.0 - views * (1.0 - beta)) for beta in betas)
        return cls((first, second), EPS / sqrt(views), age)
