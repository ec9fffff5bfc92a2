"""Combinations of components: few combinations that contain every pair, and one short run each.

Every combination contains one component of each of five slots (`SLOTS`). The components of the
other slots (`FURTHER`: losses, exposures, initializers, resolutions, groupings, observers) are
added one at a time.
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
#: Options with which a component has an effect within these few steps.
NEEDED: Final[Mapping[tuple[str, str], Mapping[str, Any]]] = {
    ("operator", "chain"): {"links": [{"name": "symmetric"}, {"name": "mean"}]},
    # With threshold 0, every anchor is judged at the first edit. With a small `voxel_size`, there
    # are free cells near the anchors.
    ("backbone", "scaffold"): {"voxel_size": 1e-5},
    ("densifier", "anchor"): {"success_threshold": 0, "coarsest": 1},
    ("densifier", "octree"): {"success_threshold": 0},
    # Each Gaussian is blended in only a few pixels of this small scene, so the threshold must be 0.
    ("densifier", "multiview"): {"importance": 0},
    ("densifier", "multiview-gate"): {"importance": 0},
}
#: Number of steps in a run of the matrix. Density control edits the primitives in steps 2 and 4,
#: and resets opacities in step 4.
STEPS: Final = 5
_WINDOW: Final = {"densify_from": 1, "densify_every": 2, "densify_until": 100}
_TIMES: Final = {"schedule_unit": "steps", "reset_every": 4, **_WINDOW}
#: One combination: the names of its components, in the order of the slots.
Row: TypeAlias = tuple[str, ...]
#: Combination -> reasons why it was refused. Combinations that can be trained are not keys of this
#: mapping.
Refused: TypeAlias = Mapping[Row, Collection[str]]


@dataclass(frozen=True)
class Factors:
    """Combinations of the components of some slots.

    Attributes:
        slots: The slots, in the order of the names in a combination.
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
    """Return the smallest K above 1 that sampler and operator allow.

    With K above 1, operators have an effect.
    """
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

    A line stands for all combinations that contain its names. Together, the lines describe all
    refused combinations and no other combination.
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
    """Return the fewest slots whose names separate the given combinations from all others."""
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
    """Yield few allowed combinations of one value with every value of the other factors.

    First, the n-th values of all other factors are combined. A value that is not yet in an allowed
    combination is then tried with the default values of the other factors; one of these defaults is
    changed at a time. Not every combination is tried, because there can be too many.

    Args:
        place: Index of the factor that the value belongs to.
        value: The value that all combinations contain.
        values: The values of each factor.
        usual: Function that completes a combination in which only some values are given.
        admits: Function that returns True if the components of a combination work together.
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
