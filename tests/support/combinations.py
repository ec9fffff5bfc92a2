"""Every combination of components of five slots: which are refused, and why.

    python -m support.combinations > tests/matrix/refusals.txt

writes down the refusals of what is installed from the distribution `crossgrad`, in as few lines as
say exactly the same: a reason that depends on the sampler and the operator alone is one line for
all backbones and densifiers.
"""

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from itertools import combinations, product
from typing import Any, Final, TypeAlias

from support.pairwise import Row

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.sampler import Sampler
from crossgrad_core.registry.entries import build, load, offers
from crossgrad_core.run.assemble import reasons_against
from crossgrad_core.run.select import select
from crossgrad_core.testing.fixtures import sample_scene

SLOTS: Final = ("sampler", "operator", "backbone", "densifier", "rasterizer")
#: Options without which a component has nothing to do in so few steps.
NEEDED: Final[Mapping[tuple[str, str], Mapping[str, Any]]] = {
    ("operator", "chain"): {"links": [{"name": "symmetric"}, {"name": "mean"}]},
    # Anchors are judged at once, and find free cells near by.
    ("backbone", "scaffold"): {"voxel_size": 1e-5},
    ("densifier", "anchor"): {"success_threshold": 0, "coarsest": 1},
    ("densifier", "octree"): {"success_threshold": 0},
    # In so small a scene no primitive is blended in many pixels.
    ("densifier", "multiview"): {"importance": 0},
    ("densifier", "multiview-gate"): {"importance": 0},
}
#: A run of the matrix: density control edits in steps 2 and 4 and resets opacities in step 4.
STEPS: Final = 5
_WINDOW: Final = {"densify_from": 1, "densify_every": 2, "densify_until": 100}
_TIMES: Final = {"events": "steps", "reset_every": 4, **_WINDOW}

#: Row -> reasons; rows that work are not there.
Refused: TypeAlias = Mapping[Row, Collection[str]]


@cache
def every_combination(distribution: str = "crossgrad") -> tuple[Row, ...]:
    """One name per slot of `SLOTS`, all there are of one distribution, in alphabetical order.

    Of the rasterizers those that run on a CPU: the others are refused here, whatever else is named.
    """
    return tuple(product(*(sorted(_names(slot, distribution)) for slot in SLOTS)))


def _names(slot: str, distribution: str) -> list[str]:
    names = [entry.name for entry in offers(f"{slot}s") if entry.distribution == distribution]
    if slot != "rasterizer":
        return names
    return [name for name in names if "cpu" in load(Rasterizer, name).devices]


def config_of(row: Row) -> RunConfig:
    """A short run of one combination whose density control acts."""
    choices = {
        slot: ComponentChoice.model_validate({"name": name, **NEEDED.get((slot, name), {})})
        for slot, name in zip(SLOTS, row, strict=True)
    }
    views = _several_views(choices["sampler"], choices["operator"])
    few = {"steps": 100, "views": views, "metrics": [{"name": "psnr"}], "start": {"name": "sfm"}}
    return RunConfig.model_validate({"device": "cpu", **few, **choices, **_TIMES})


@cache
def _several_views(sampler: ComponentChoice, operator: ComponentChoice) -> int | None:
    """The smallest K above 1 that both admit, so that operators have something to do."""
    counts = (
        build(Sampler, sampler.name, sampler.options).view_counts,
        build(Operator, operator.name, operator.options).views,
    )
    both = (k for k in range(2, 7) if all(each.admits(k) for each in counts))
    return next(both, None)


def refused(rows: Iterable[Row]) -> dict[Row, tuple[str, ...]]:
    """The reasons for which combinations are refused, before anything is trained."""
    found = {}
    for row in rows:
        config = config_of(row)
        selection, _ = select(config, sample_scene(), "none")
        # What the manager would gather; registering with it would take most of the time.
        asked = (getattr(c, "crossgrad_objections", None) for c in selection.components.values())
        answers = [ask(selection) for ask in asked if ask is not None]
        reasons = reasons_against(config, selection, answers)
        if reasons:
            found[row] = reasons
    return found


def as_lines(refusals: Refused, rows: Sequence[Row]) -> list[str]:
    """The refusals among `rows` as sorted lines `slot=name slot=name: reason`.

    A line speaks for all rows with these names; together the lines say neither more nor less than
    the refusals.
    """
    by_reason: dict[str, set[Row]] = {}
    for row, reasons in refusals.items():
        for reason in reasons:
            by_reason.setdefault(reason, set()).add(row)
    lines = []
    for reason, concerned in by_reason.items():
        slots = _slots_that_decide(concerned, rows)
        for names in {tuple(row[i] for i in slots) for row in concerned}:
            named = (f"{SLOTS[i]}={name}" for i, name in zip(slots, names, strict=True))
            lines.append(f"{' '.join(named)}: {reason}")
    return sorted(lines)


def from_lines(lines: Iterable[str], rows: Iterable[Row]) -> dict[Row, list[str]]:
    """The refusals that lines of `as_lines` stand for."""
    patterns = []
    for line in lines:
        named, reason = line.split(": ", 1)
        pairs = (part.split("=", 1) for part in named.split())
        patterns.append(([(SLOTS.index(slot), name) for slot, name in pairs], reason))
    found: dict[Row, list[str]] = {}
    for row in rows:
        for pattern, reason in patterns:
            if all(row[i] == name for i, name in pattern):
                found.setdefault(row, []).append(reason)
    return found


def _slots_that_decide(concerned: set[Row], rows: Sequence[Row]) -> tuple[int, ...]:
    """The fewest slots whose names tell the rows that are concerned from all others."""
    for count in range(len(SLOTS)):
        for slots in combinations(range(len(SLOTS)), count):
            named = {tuple(row[i] for i in slots) for row in concerned}
            if all(row in concerned for row in rows if tuple(row[i] for i in slots) in named):
                return slots
    return tuple(range(len(SLOTS)))


if __name__ == "__main__":
    everything = every_combination()
    sys.stdout.writelines(f"{line}\n" for line in as_lines(refused(everything), everything))
