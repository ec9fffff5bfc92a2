"""Steps that take given seconds, whatever the machine does: for runs whose budget is time."""

import pytest

from crossgrad_core.training.clock import Clock, Laps


def each_step_takes(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Every step of the runs of this process counts so many seconds on both of its clocks."""

    def count(self: Clock, laps: Laps) -> None:
        counted(self, Laps(total=seconds, spent={"other": seconds}, cpu=seconds))

    counted = Clock.count
    monkeypatch.setattr(Clock, "count", count)
