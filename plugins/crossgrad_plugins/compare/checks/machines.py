"""Seconds compare only between runs of one quiet machine."""

from collections.abc import Sequence
from typing import Any, Final

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.cost import COSTS, CPU_SECONDS, SECONDS, ClockChoice, Cost
from crossgrad_plugins.compare.run import Run

#: What makes a machine, and beyond it a way to use it.
_MACHINE: Final = {"cpu": "processor", "gpu": "GPU", "device": "device"}
_SHARE: Final = {"cpu_cores": "number of cores", "torch_threads": "number of threads"}
#: Rate of the calibration -> how much it may differ: on the clock, and in CPU time, of which other
#: processes on the same core and cache take some even where they do not take the core.
_SAME_SPEED: Final = {"rate": 0.1, "cpu_rate": 0.25}
#: Load above the number of cores from which on a machine is busy with other things.
_BUSY: Final = 0.5


def comparable_costs(runs: Sequence[Run], clock: ClockChoice) -> tuple[tuple[Cost, ...], list[str]]:
    """What runs spend that can be compared, and notes on what cannot.

    Args:
        runs: The runs.
        clock: The seconds that are wanted: by default those of the clock where they compare, else
            those of the processor, else none.

    Raises:
        UserError: The wanted seconds do not compare, with the reason.
    """
    reasons = {SECONDS: _why_no_wall(runs), CPU_SECONDS: _why_no_cpu(runs)}
    wanted = {ClockChoice.WALL: SECONDS, ClockChoice.CPU: CPU_SECONDS}.get(clock)
    if wanted is not None and reasons[wanted]:
        raise UserError(
            f"{wanted.title} of these runs do not compare",
            where=f"--clock {clock}",
            found=reasons[wanted],
            todo="leave --clock out: quality at equal steps and views is compared then"
            + ("" if reasons[CPU_SECONDS] else "; --clock cpu compares CPU seconds"),
        )
    left_out = {cost for cost, reason in reasons.items() if reason}
    if clock is not ClockChoice.AUTO:
        left_out |= {SECONDS, CPU_SECONDS} - {wanted}
    notes = [
        f"{_CLOCK if cost is SECONDS else cost.title} are not compared: {reason}"
        for cost, reason in reasons.items()
        if reason and clock is ClockChoice.AUTO and reason != _NEVER_RECORDED
    ]
    return tuple(cost for cost in COSTS if cost not in left_out), notes


#: Beside seconds of CPU, which may be compared all the same.
_CLOCK: Final = "seconds of the clock"
_NEVER_RECORDED: Final = "no run recorded them"


def _why_no_wall(runs: Sequence[Run]) -> str:
    """Why seconds of the clock do not compare; empty where they do."""
    return (
        _other_machine(runs, {**_MACHINE, **_SHARE})
        or _busy(runs)
        or _other_speed(runs, "rate")
        or _unrecorded(runs, SECONDS)
    )


def _why_no_cpu(runs: Sequence[Run]) -> str:
    return (
        _unrecorded(runs, CPU_SECONDS)
        or _other_machine(runs, _MACHINE)
        or _threads(runs)
        or _other_speed(runs, "cpu_rate")
    )


def _other_machine(runs: Sequence[Run], fields: dict[str, str]) -> str:
    first = runs[0]
    for run in runs[1:]:
        for field, words in fields.items():
            one, other = _environment(first).get(field), _environment(run).get(field)
            if one != other:
                return f"{words} {one} of {first.name}, {other} of {run.name}"
    return ""


def _other_speed(runs: Sequence[Run], name: str) -> str:
    """Whether the machine itself ran at another speed, as its calibration tells."""
    known = [(run.number("environment", "calibration", name), run) for run in runs]
    rates = [(rate, run) for rate, run in known if rate is not None]
    if len(rates) < len(runs):
        return ""
    (low, slow), (high, fast) = min(rates, key=_first), max(rates, key=_first)
    if high <= (1.0 + _SAME_SPEED[name]) * low:
        return ""
    return (
        f"the machine's calibration was {high / low - 1.0:.0%} faster at {fast.name} "
        f"than at {slow.name}"
    )


def _first(pair: tuple[float, Run]) -> float:
    return pair[0]


def _busy(runs: Sequence[Run]) -> str:
    for run in runs:
        load, cores = (
            run.number("environment", "load", "mean"),
            run.number("environment", "cpu_cores"),
        )
        if load is not None and cores is not None and load > cores + _BUSY:
            return f"the machine was busy: a load of {load:.1f} on {cores:g} cores at {run.name}"
    return ""


def _threads(runs: Sequence[Run]) -> str:
    """Threads that wait spin: their CPU seconds count, but nothing comes of them."""
    for run in runs:
        threads = run.number("environment", "torch_threads")
        if threads is not None and threads > 1:
            return f"they only compare with one thread, and {run.name} has {threads:g}"
    return ""


def _unrecorded(runs: Sequence[Run], cost: Cost) -> str:
    lacking = [run.name for run in runs if run.spent(cost) is None]
    if not lacking:
        return ""
    return _NEVER_RECORDED if len(lacking) == len(runs) else f"{lacking[0]} did not record them"


def _environment(run: Run) -> dict[str, Any]:
    return dict(run.summary.get("environment") or {})
