"""The figure of the milliseconds that each phase of a step took."""

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.figures.style import (
    COLORS,
    FAINT,
    PAGE,
    Drawn,
    drawn,
    legend_above,
    literal,
    new_figure,
    styled,
    wrapped,
)
from crossgrad_plugins.compare.quantity import SECONDS

_OTHER = "other"
#: Number of characters per line of an arm's name beside its bar.
_LETTERS = 40
_HATCHES = ("", "", "", "", "", "", "", "///", "...", "xxx")


def phases_of(comparison: Comparison) -> dict[str, dict[str, float]]:
    """Return milliseconds per step by arm and phase.

    The values are means over the runs that recorded phases. The milliseconds are wall-clock time.
    The result is empty if wall-clock seconds are not comparable or were not requested.
    """
    by_arm: dict[str, dict[str, float]] = {}
    if SECONDS not in comparison.costs:
        return by_arm
    for arm, by in comparison.main.items():
        runs = [run for run in by.values() if run.number("step")]
        recorded = [run.summary.get("seconds", {}).get("phases") or {} for run in runs]
        per_run = [
            {
                name: 1000.0 * seconds / (run.number("step") or 1.0)
                for name, seconds in phases.items()
            }
            for run, phases in zip(runs, recorded, strict=True)
            if phases
        ]
        if per_run:
            names = list(dict.fromkeys(name for phases in per_run for name in phases))
            by_arm[arm] = {
                n: float(np.mean([phases.get(n, 0.0) for phases in per_run])) for n in names
            }
    return by_arm


def draw_phases(comparison: Comparison) -> Drawn | None:
    """Draw milliseconds per step by phase, one bar per arm.

    Return None without comparable runs.
    """
    by_arm = phases_of(comparison)
    if not by_arm:
        return None
    names = list(dict.fromkeys(name for phases in by_arm.values() for name in phases))
    colors = {
        name: FAINT if name == _OTHER else COLORS[index % len(COLORS)]
        for index, name in enumerate(names)
    }
    with styled():
        figure = new_figure(PAGE, 0.85 + 0.3 * len(by_arm))
        ax = figure.subplots()
        for row, phases in enumerate(by_arm.values()):
            left = 0.0
            for index, name in enumerate(names):
                wide = phases.get(name, 0.0)
                ax.barh(row, wide, left=left, height=0.62, color=colors[name], alpha=0.85,
                        hatch=_HATCHES[index % len(_HATCHES)], edgecolor="white", linewidth=0.4,
                        label=None if row else name.replace("_", " "))  # fmt: skip
                left += wide
        ax.set_yticks(range(len(by_arm)), [wrapped(literal(arm), _LETTERS) for arm in by_arm])
        ax.invert_yaxis()
        ax.grid(visible=False, axis="y")
        ax.set_xlabel("milliseconds of a training step")
        legend_above(figure, *ax.get_legend_handles_labels(), 5)
        return drawn(
            figure,
            "phases",
            "Training time by phase",
            "Wall-clock seconds by phase of a step, mean over runs.",
        )
