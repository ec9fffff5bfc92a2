"""A finished run, and the settings that separate arms."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.compare.quantity import Cost

if TYPE_CHECKING:
    from crossgrad_core.commands import RunResults


Array: TypeAlias = NDArray[np.float64]
#: A value of a setting as text, such as `0.4`, `scaffold` or `pcgrad+soft`.
Settings: TypeAlias = dict[str, str]
#: The text for a setting that is not set.
ABSENT: Final = "-"
#: Settings that do not separate arms: paths and length of a run, and components that only observe.
_NO_ARM: Final = frozenset(
    {
        *("crossgrad", "scene", "seed", "out"),
        *("steps", "max_views", "seconds", "revisions", "planned_seconds", "stop_after", "clock"),
        *("eval_every", "eval_from", "save_every", "threads", "max_nonfinite_blocks"),
        *("observers", "metrics", "exporter"),
        *("data.cache_mib", "data.disk_mib", "data.masks"),
    }
)


@dataclass(frozen=True, eq=False)
class Run:
    """A run that has ended.

    Attributes:
        name: The folder of the run, as shown to users.
        results: The results of the run.
        summary: Content of summary.json.
        config: The configuration of the run, converted to the format of this version.
        label: Label of the run's configuration in a sweep; None if there is no sweep.
    """

    name: str
    results: "RunResults"
    summary: Mapping[str, Any]
    config: Mapping[str, Any]
    label: str | None = None

    @property
    def scene(self) -> str:
        """The name of the run's scene."""
        return str(self.summary.get("scene") or "scene")

    @property
    def seed(self) -> int:
        """The seed of the run."""
        return int(self.config.get("seed") or 0)

    @property
    def status(self) -> str:
        """The status of the run: finished, stopped or failed."""
        return str(self.summary.get("status"))

    @property
    def environment(self) -> Mapping[str, Any]:
        """The machine and the code of the run, from summary.json."""
        return self.summary.get("environment") or {}

    @cached_property
    def settings(self) -> Settings:
        """The configuration as flat settings, without settings that do not separate arms."""
        return settings_of(self.config)

    @cached_property
    def length(self) -> tuple[str, float]:
        """The unit and amount of the run's budget."""
        if seconds := self.config.get("planned_seconds"):
            return ("s CPU" if self.config.get("clock") == "cpu" else "s"), float(seconds)
        views = self.config.get("max_views")
        if views is not None:
            return "views", float(views)
        return "steps", float(self.config.get("steps") or self.summary.get("step") or 0)

    @property
    def length_text(self) -> str:
        """The budget of the run as text, such as `70 s`."""
        return text_of(self.length)

    def final(self, name: str, regime: str | None = None) -> float | None:
        """Return the final metric, overall or of a regime; None if missing or not finite."""
        value = self.results.figure(name, regime)
        return value if value is not None and isfinite(value) else None

    def series(self, name: str, cost: Cost, regime: str | None = None) -> tuple[Array, Array]:
        """Return the costs [n] and the metric values [n] of a run's evaluations.

        The costs are in ascending order.
        """
        points = self.results.curve(name, regime, over=cost.column)
        values = {x: y for x, y in points if isfinite(x) and isfinite(y)}
        x = np.array(sorted(values), dtype=np.float64)
        return x, np.array([values[amount] for amount in sorted(values)], dtype=np.float64)

    def spent(self, cost: Cost) -> float | None:
        """Return the total cost; None if it was not recorded."""
        value = self.summary.get(cost.column)
        return float(value) if isinstance(value, int | float) and isfinite(value) else None

    def number(self, *names: str) -> float | None:
        """Return a number of summary.json by its path of keys; None if it does not exist."""
        value: Any = self.summary
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        is_number = (
            isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        )
        return float(value) if is_number else None


def text_of(length: tuple[str, float]) -> str:
    """Format a length, such as `70 s`."""
    return f"{length[1]:,g} {length[0]}"


def settings_of(config: Mapping[str, Any]) -> Settings:
    """Return the values of the settings that can separate arms: setting -> value.

    A setting with the value null counts as not set, and its text is `-`. A component is listed as
    `backbone`, and an option of it as `backbone.sh_degree`. Several operators are listed as one
    `operator` with names joined by `+`; an option is listed as `operator.1.c`.
    """
    return {
        name: _text(value)
        for name, value in _flat("", config)
        if not _NO_ARM & {name, name.partition(".")[0]}
    }


def _flat(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(name if key == "name" and name else f"{name}.{key}".strip("."), inner)
    elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        links = [item for item in value if isinstance(item, Mapping)]
        yield name, "+".join(str(link.get("name")) for link in links)
        for number, link in enumerate(links):
            options = {key: inner for key, inner in link.items() if key != "name"}
            yield from _flat(f"{name}.{number}", options)
    else:
        yield name, value


def _text(value: object) -> str:
    if value is None:
        return ABSENT
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ",".join(_text(item) for item in value)
    return str(value)
