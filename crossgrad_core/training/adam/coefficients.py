"""The coefficients of one Adam step."""

from dataclasses import dataclass
from math import sqrt

# Gradients and first moments below this count as 0, because they would become subnormal during
# decay. With eps = 1e-15, smaller values move a parameter by less than 1e-14 of its learning rate.
TINY = 1e-30


# Second moments below float32's smallest normal number count as 0, because subnormal numbers are
# slow on most processors. Their root, 1e-19, is negligible against eps = 1e-15.
SMALLEST_NORMAL = 2.0**-126


# Gradients are clamped to this magnitude. The square of a larger gradient overflows float32, and an
# infinite second moment would stop its parameter permanently.
LARGEST = 1e18


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of one tensor's step.

    Attributes:
        beta1: Decay of the first moment.
        beta2: Decay of the second moment.
        lr: Learning rate.
        age: t, number of steps so far as bias correction counts them, including this step.
        eps: Added to the root of the corrected second moment.
        scale: Factor for the gradient.
        from_zero: True if the tensor is uninitialised; it then counts as zero before the step.
    """

    beta1: float
    beta2: float
    lr: float
    age: float
    eps: float
    scale: float = 1.0
    from_zero: bool = False

    @property
    def step_size(self) -> float:
        """Learning rate / (1 - beta1^t)."""
        return self.lr / float(1 - self.beta1**self.age)

    @property
    def root_scale(self) -> float:
        """1 / sqrt(1 - beta2^t)."""
        return 1 / sqrt(1 - self.beta2**self.age)

    @property
    def square_floor(self) -> float:
        """Smallest gradient whose contribution to the second moment is not subnormal."""
        return sqrt(SMALLEST_NORMAL / (1 - self.beta2))
