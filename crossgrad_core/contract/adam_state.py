"""Adam's moments and step counts."""

from dataclasses import dataclass, field

from torch import Tensor


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
