"""Combinations of components: few rows that contain every pair, and the run of one row.

Every combination contains components of five slots. The components of further slots (losses,
exposures, initializers, resolutions, groupings, observers) are added to such combinations one at a
time.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product
from typing import Any, Final, TypeAlias

from crossgrad_core.commands import (
    ComponentChoice,
    RunConfig,
    UserError,
    build,
    entries,
    load_component,
    plural,
)
from crossgrad_core.plugin import Backbone, Operator, Rasterizer, Sampler

SLOTS: Final = ("sampler", "operator", "backbone", "densifier", "rasterizer")
FURTHER: Final = ("loss", "exposure", "initializer", "resolution", "grouping", "observer")
#: Options that make a component have an effect within these few steps.
NEEDED: Final[Mapping[tuple[str, str], Mapping[str, Any]]] = {
    ("operator", "chain"): {"links": [{"name": "symmetric"}, {"name": "mean"}]},
    # With this option, anchors are judged at the first edit. Small cells leave free cells nearby.
    ("backbone", "scaffold"): {"voxel_size": 1e-5},
    ("densifier", "anchor"): {"success_threshold": 0, "coarsest": 1},
    ("densifier", "octree"): {"success_threshold": 0},
    # In this small scene, each Gaussian is blended in only a few pixels.
    ("densifier", "multiview"): {"importance": 0},
    ("densifier", "multiview-gate"): {"importance": 0},
}
#: Number of steps in a run of the matrix. Density control edits in steps 2 and 4, and opacities are
#: reset in step 4.
STEPS: Final = 5
_WINDOW: Final = {"densify_from": 1, "densify_every": 2, "densify_until": 100}
_TIMES: Final = {"schedule_unit": "steps", "reset_every": 4, **_WINDOW}
#: A row contains one value for each factor.
Row: TypeAlias = tuple[str, ...]
#: Row -> reasons why it was refused. Rows that work are not in the mapping.
Refused: TypeAlias = Mapping[Row, Collection[str]]


@dataclass(frozen=True)
class Factors:
    """Combinations of the components of some slots.

    Attributes:
        slots: The slots, in the order of the names in a row.
        rows: The combinations.
    """

    slots: tuple[str, ...]
    rows: tuple[Row, ...]


def every_row(names: Mapping[str, Iterable[str]]) -> tuple[Row, ...]:
    """Return all combinations of one name per slot of `SLOTS`, in alphabetical order."""
    return tuple(product(*(sorted(names[slot]) for slot in SLOTS)))


def default_row(given: Mapping[str, str], slots: Sequence[str]) -> Row:
    """Complete a combination with the default component of each slot that is not given."""
    backbone = given.get("backbone", _default("backbone"))
    names = {"densifier": load_component(Backbone, backbone).default_densifier, **given}
    return tuple(names.get(slot) or _default(slot) for slot in slots)


def _default(slot: str) -> str:
    """Return the default name of a slot; for rasterizers, the fastest on the CPU."""
    if slot == "rasterizer":
        return max(entries("rasterizers"), key=_speed)
    config = RunConfig.model_validate({})
    choice = config.operators[0] if slot == "operator" else getattr(config, slot)
    return str(choice.name)


def _speed(rasterizer: str) -> float:
    try:
        return load_component(Rasterizer, rasterizer).speed("cpu")
    except UserError:
        return 0.0


def device_of(rasterizer: str) -> str:
    """Return the device for testing a rasterizer: the CPU if the rasterizer supports it."""
    return "cpu" if "cpu" in load_component(Rasterizer, rasterizer).devices else "cuda"


def config_of(row: Row, slots: Sequence[str] = SLOTS) -> RunConfig:
    """Return the configuration of a short run of one combination, with active density control."""
    choices = {
        slot: ComponentChoice.model_validate({"name": name, **NEEDED.get((slot, name), {})})
        for slot, name in zip(slots, row, strict=True)
    }
    settings: dict[str, Any] = {
        "steps": 100,
        "views": _several_views(choices["sampler"], choices["operator"]),
        "metrics": [{"name": "psnr"}],
        "initializer": {"name": "points"},
        "device": device_of(choices["rasterizer"].name),
    }
    for slot, choice in choices.items():
        settings |= {plural(slot): (choice,)} if slot == "observer" else {slot: choice}
    return RunConfig.model_validate({**settings, **_TIMES})


@cache
def _several_views(sampler: ComponentChoice, operator: ComponentChoice) -> int | None:
    """Return the smallest K above 1 that both admit, so that operators have an effect."""
    counts = (
        build(Sampler, sampler.name, sampler.options).view_counts,
        build(Operator, operator.name, operator.options).views,
    )
    both = (k for k in range(2, 7) if all(count.admits(k) for count in counts))
    return next(both, None)


def named(row: Row, slots: Sequence[str] = SLOTS) -> str:
    """Format a combination as `slot=name slot=name`."""
    return " ".join(f"{slot}={name}" for slot, name in zip(slots, row, strict=True))


def as_lines(refusals: Refused, rows: Sequence[Row], slots: Sequence[str] = SLOTS) -> list[str]:
    """Format the refusals among `rows` as sorted lines `slot=name slot=name: reason`.

    A line covers all rows with these names. Together, the lines cover exactly the refusals.
    """
    by_reason: dict[str, set[Row]] = {}
    for row, reasons in refusals.items():
        for reason in reasons:
            by_reason.setdefault(reason, set()).add(row)
    lines = []
    for reason, concerned in by_reason.items():
        places = _slots_that_decide(concerned, rows)
        deciding = [slots[i] for i in places]
        names = {tuple(row[i] for i in places) for row in concerned}
        lines += [f"{named(combination, deciding)}: {reason}" for combination in names]
    return sorted(lines)


def _slots_that_decide(concerned: set[Row], rows: Sequence[Row]) -> tuple[int, ...]:
    """Return the fewest slots whose names separate the given rows from all other rows."""
    everything = range(len(rows[0]))
    for count in everything:
        for places in combinations(everything, count):
            names = {tuple(row[i] for i in places) for row in concerned}
            if all(row in concerned for row in rows if tuple(row[i] for i in places) in names):
                return places
    return tuple(everything)


def meetings(
    place: int,
    value: str,
    values: Sequence[Sequence[str]],
    usual: Callable[[Mapping[int, str]], Row],
    admits: Callable[[Row], bool],
) -> Iterator[Row]:
    """Yield few admitted rows in which one value meets every value of the other factors.

    First, the values of all factors are combined in turn. A value without an admitted row so far is
    then tried with the default values of the other factors; one factor at a time is changed. Not
    every row is tried, because many factors have too many rows.

    Args:
        place: Factor of the value.
        value: The value.
        values: The values of each factor.
        usual: Completes a row in which some values are given.
        admits: Function that returns True if the components of a row can be combined.
    """
    missing = {(i, name) for i, names in enumerate(values) if i != place for name in names}
    for turn in range(max(map(len, values))):
        given = dict(enumerate(names[turn % len(names)] for names in values)) | {place: value}
        row = tuple(given[i] for i in range(len(values)))
        if missing.intersection(enumerate(row)) and admits(row):
            missing -= set(enumerate(row))
            yield row
    for i, name in sorted(missing):
        fixed = {place: value, i: name}
        changes: list[dict[int, str]] = [{}]
        changes += [{j: v} for j, names in enumerate(values) if j not in fixed for v in names]
        rows = (usual({**fixed, **change}) for change in changes)
        admitted = next(filter(admits, dict.fromkeys(rows)), None)
        if admitted is not None:
            yield admitted
