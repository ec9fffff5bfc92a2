"""The cost of a run so far."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Totals:
    """The cost side of an evaluation.

    Attributes:
        step: Optimizer steps.
        views: Rendered training views.
        backward_passes: Backward passes.
        train_seconds: Training seconds; compiling, loading, evaluating and reporting excluded.
        primitives: Number of primitives.
        peak_memory_mib: Peak memory, MiB; None where the system does not say.
        loss: Mean photometric loss of the last step, None before the first.
        cpu_seconds: CPU seconds of the process in the training seconds, all threads together.
        peak_primitives: The most primitives that there were after a step; None where unknown.
    """

    step: int
    views: int
    backward_passes: int
    train_seconds: float
    primitives: int
    peak_memory_mib: float | None
    loss: float | None
    cpu_seconds: float = 0.0
    peak_primitives: int | None = None
