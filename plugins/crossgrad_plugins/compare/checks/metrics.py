"""Figures compare only where they have one definition."""

from collections.abc import Sequence
from typing import Any, Final

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run

#: The definition that holds for every metric: how renders are compared at all.
_RENDERS: Final = "renders"


def quantities_of(
    runs: Sequence[Run], name: str, margin: float | None
) -> tuple[tuple[Quantity, ...], list[str]]:
    """The figures that can be compared, the main one first, and notes on those that cannot.

    Args:
        runs: The runs.
        name: Name of the main figure.
        margin: Its margin; by default the usual one.

    Raises:
        UserError: No run has the main figure, or runs define it, or how renders are compared,
            differently.
    """
    offered = dict.fromkeys(key for run in runs for key in _overall(run) if key != "views")
    measured = [key for key in offered if any(run.final(key) is not None for run in runs)]
    if not measured:
        raise UserError(
            "no run has a figure: none of them held a photo out",
            where=runs[0].name,
            todo="repeat the runs without --split none, and with more photos where there are few",
        )
    if name not in measured:
        raise UserError(
            "no run has this figure",
            where="--metric",
            expected=f"one of {', '.join(measured)}",
            found=name,
            todo="choose another one, or repeat the runs with it: crossgrad run --metrics NAME",
        )
    for key in (_RENDERS, name):
        _check_definition(runs, key)
    notes, kept = [], [name]
    for key in measured:
        if key == name:
            continue
        if len(_definitions(runs, key)) > 1:
            notes.append(f"{key} is not compared: runs define it differently")
        elif lacking := [run.name for run in runs if key not in _overall(run)]:
            notes.append(f"{key} is not compared: {lacking[0]} and others did not measure it"
                         if len(lacking) > 1 else
                         f"{key} is not compared: {lacking[0]} did not measure it")  # fmt: skip
        else:
            kept.append(key)
    falling = {str(key) for run in runs for key in run.summary.get("falling") or ()}
    found = (
        Quantity.of(key, margin if key == name else None, falls=key in falling) for key in kept
    )
    return tuple(found), notes


def _check_definition(runs: Sequence[Run], key: str) -> None:
    found = _definitions(runs, key)
    if len(found) > 1:
        (first, one), (second, other), *_ = ((text, run) for text, run in found.items())
        raise UserError(
            f"runs define {key} differently"
            if key != _RENDERS
            else "runs compare renders by different rules",
            where=f"{one}, {other}",
            expected="one definition in summary.json",
            found=f"{first!r} against {second!r}",
            todo="compare runs of one version, or repeat those of the other one",
        )


def _definitions(runs: Sequence[Run], key: str) -> dict[str, str]:
    """Definition -> the first run that has it; runs that do not state one agree with all."""
    found: dict[str, str] = {}
    for run in runs:
        text = (run.summary.get("definitions") or {}).get(key)
        if text is not None:
            found.setdefault(str(text), run.name)
    return found


def _overall(run: Run) -> dict[str, Any]:
    return dict(run.summary.get("overall") or {})
