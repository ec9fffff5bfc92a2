"""Steps that take given seconds, whatever the machine does: for runs whose budget is time."""

import pytest

from crossgrad_core.run.results.machine import Calibration
from crossgrad_core.training.state import Clock, PhaseTimer


def each_step_takes(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Every step of the runs of this process counts so many seconds on both of its clocks.

    What is done after the last step counts none.

    Runs that become long by that do not measure the machine for two real seconds.
    """

    def count(self: Clock, laps: PhaseTimer) -> None:
        each = seconds if "render" in laps.spent else 0.0
        counted(self, PhaseTimer(total=each, spent={"other": each}, cpu=each))

    counted = Clock.count
    monkeypatch.setattr(Clock, "count", count)
    known = Calibration(2.0, 1.0, 1.0)
    monkeypatch.setattr("crossgrad_core.run.results.machine.calibrated", lambda: known)
