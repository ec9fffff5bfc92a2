"""A finished run as the comparison sees it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.settings import Settings, settings_of

if TYPE_CHECKING:
    from crossgrad_core.commands import RunResults

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Run:
    """A run that has ended.

    Attributes:
        name: Its folder as it is shown.
        results: What it wrote.
        summary: Its summary.json.
        config: Its configuration as this version has it.
        label: What its sweep calls its configuration; None where there is no sweep.
    """

    name: str
    results: "RunResults"
    summary: Mapping[str, Any]
    config: Mapping[str, Any]
    label: str | None = None

    @property
    def scene(self) -> str:
        """Name of its scene."""
        return str(self.summary.get("scene") or "scene")

    @property
    def seed(self) -> int:
        """Its seed."""
        return int(self.config.get("seed") or 0)

    @property
    def status(self) -> str:
        """How it ended: finished, stopped or failed."""
        return str(self.summary.get("status"))

    @property
    def environment(self) -> Mapping[str, Any]:
        """Its machine and code, as summary.json has them."""
        return self.summary.get("environment") or {}

    @cached_property
    def settings(self) -> Settings:
        """Its configuration, flat, without what tells no arms apart."""
        return settings_of(self.config)

    @cached_property
    def length(self) -> tuple[str, float]:
        """The unit and the amount of the budget that it was given."""
        if seconds := self.config.get("planned_seconds"):
            return ("s CPU" if self.config.get("clock") == "cpu" else "s"), float(seconds)
        views = self.config.get("max_views")
        if views is not None:
            return "views", float(views)
        return "steps", float(self.config.get("steps") or self.summary.get("step") or 0)

    @property
    def length_text(self) -> str:
        """Its budget as text, such as `70 s`."""
        return text_of(self.length)

    def final(self, name: str, regime: str | None = None) -> float | None:
        """A figure at its end, overall or of a regime; None where there is none or it is NaN."""
        value = self.results.figure(name, regime)
        return value if value is not None and isfinite(value) else None

    def series(self, name: str, cost: Cost, regime: str | None = None) -> tuple[Array, Array]:
        """What had been spent at each evaluation [n], rising, and the figure there [n]."""
        points = self.results.curve(name, regime, over=cost.column)
        known = {x: y for x, y in points if isfinite(x) and isfinite(y)}
        x = np.array(sorted(known), dtype=np.float64)
        return x, np.array([known[each] for each in sorted(known)], dtype=np.float64)

    def spent(self, cost: Cost) -> float | None:
        """What it spent in all; None where it was not recorded."""
        value = self.summary.get(cost.column)
        return float(value) if isinstance(value, int | float) and isfinite(value) else None

    def number(self, *names: str) -> float | None:
        """A number of summary.json by the names of the objects around it; None without one."""
        value: Any = self.summary
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        known = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        return float(value) if known else None


def text_of(length: tuple[str, float]) -> str:
    """A length as text, such as `70 s`."""
    return f"{length[1]:,g} {length[0]}"
