"""The coefficients of one Adam step."""

from dataclasses import dataclass
from math import sqrt

# Gradients and first moments below this value count as 0. Further decay would make these gradients
# and moments subnormal. With eps = 1e-15, a smaller first moment moves a parameter by less than
# 1e-14 times the learning rate.
TINY = 1e-30


# Second moments below float32's smallest normal number count as 0, because subnormal numbers are
# slow on most processors. The square root of the smallest normal number is 1e-19, which is
# negligible compared with eps = 1e-15.
SMALLEST_NORMAL = 2.0**-126


# Gradients are clamped to this magnitude. The square of a larger gradient overflows float32, and an
# infinite second moment would stop the updates of its parameter permanently.
LARGEST = 1e18


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of one Adam step of one tensor.

    Attributes:
        beta1: Decay rate of the first moment.
        beta2: Decay rate of the second moment.
        lr: Learning rate.
        age: Number of steps t in the bias correction, including this step.
        eps: Constant added to the square root of the corrected second moment.
        scale: Factor for the gradient.
        from_zero: True if the tensor is uninitialised. The values of an uninitialised tensor are
            set to zero before the step.
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
        """Learning rate / (1 - beta1^t), with t = `age`."""
        return self.lr / float(1 - self.beta1**self.age)

    @property
    def root_scale(self) -> float:
        """1 / sqrt(1 - beta2^t), with t = `age`."""
        return 1 / sqrt(1 - self.beta2**self.age)

    @property
    def square_floor(self) -> float:
        """Smallest gradient whose contribution to the second moment is a normal float32 number."""
        return sqrt(SMALLEST_NORMAL / (1 - self.beta2))
