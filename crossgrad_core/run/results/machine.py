"""How busy the machine was while a run trained, and how fast it is."""

import os
from dataclasses import dataclass
from time import perf_counter, thread_time

import numpy as np

from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.contract.markers import hookimpl
from crossgrad_core.contract.state import Json

#: Seconds between two looks at the load.
LOOK_SECONDS = 1.0
#: Seconds that a calibration takes.
CALIBRATION_SECONDS = 2.0
#: Runs that trained for less are not calibrated: it would take as long as they did.
WORTH_A_CALIBRATION = 20.0
#: Numbers that a pass of the fixed workload goes over, and passes between two looks at the clock.
_NUMBERS, _PASSES = 1 << 16, 8


@dataclass(frozen=True)
class Calibration:
    """The rate of a fixed workload on one thread.

    Attributes:
        seconds: How long it ran.
        rate: Passes in a second of the clock on the wall.
        cpu_rate: Passes in a second of CPU time: the machine's speed, however busy it is.
    """

    seconds: float
    rate: float
    cpu_rate: float


def calibrated(seconds: float = CALIBRATION_SECONDS) -> Calibration:
    """Runs the workload: products, exponentials and roots of 65,536 numbers in float32."""
    numbers = np.linspace(0.0, 1.0, _NUMBERS, dtype=np.float32)
    room = np.empty_like(numbers)
    passes, start, cpu = 0, perf_counter(), thread_time()
    while perf_counter() - start < seconds:
        for _ in range(_PASSES):
            np.multiply(numbers, numbers, out=room)
            np.exp(room, out=room)
            np.sqrt(room, out=room)
        passes += _PASSES
    taken, cpu = perf_counter() - start, thread_time() - cpu
    return Calibration(round(taken, 3), round(passes / taken, 1), round(passes / cpu, 1))


class Machine:
    """The machine's load during the steps of a session; a plugin of the run."""

    def __init__(self) -> None:
        self._looked = 0.0
        self._loads: list[float] = []
        self._calibration: Calibration | None = None

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Notes the load, at most once in a second."""
        now = perf_counter()
        if now - self._looked >= LOOK_SECONDS and hasattr(os, "getloadavg"):
            self._looked = now
            self._loads.append(os.getloadavg()[0])

    def figures(self, train_seconds: float) -> dict[str, Json]:
        """What summary.json says of the machine: `load` and `calibration`, null where unknown.

        Args:
            train_seconds: How long the run trained: a short one is not calibrated.
        """
        if self._calibration is None and train_seconds >= WORTH_A_CALIBRATION:
            self._calibration = calibrated()
        known = self._calibration
        loads = self._loads
        return {
            "load": {
                "mean": round(sum(loads) / len(loads), 2),
                "max": round(max(loads), 2),
            }
            if loads
            else None,
            "calibration": None if known is None else dict(vars(known)),
        }
