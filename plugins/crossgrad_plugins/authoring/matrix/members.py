"""The components that take part in the matrix of a package, and their combinations."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from crossgrad_core.commands import Entry, UserError, listed, load_entry, offers, plural, singular
from crossgrad_core.plugin import Rasterizer
from crossgrad_plugins.authoring.check import entries_of
from crossgrad_plugins.authoring.matrix.combinations import (
    FURTHER,
    SLOTS,
    Factors,
    Row,
    default_row,
    every_row,
    meetings,
)

#: Whether a combination of these slots can work.
Admits = Callable[[Row, tuple[str, ...]], bool]


@dataclass(frozen=True)
class Members:
    """The components that are combined.

    Attributes:
        package: What the package is called and its version.
        names: Slot -> the names of all installed components that can be combined.
        own: (slot, name) of the components of the package.
        left_out: Which components of others cannot be combined, and why.
    """

    package: str
    names: Mapping[str, tuple[str, ...]]
    own: frozenset[tuple[str, str]]
    left_out: tuple[str, ...]


def members_of(package: str) -> Members:
    """The components of a package, and all others that are installed.

    Raises:
        UserError: There is no such package, it has nothing that takes part in training, or one of
            its components cannot be loaded.
    """
    own = entries_of(package)
    slots = {slot: plural(slot) for slot in (*SLOTS, *FURTHER)}
    taking_part = [entry for entry in own if entry.slot in slots.values()]
    if not taking_part:
        raise UserError(
            f"package {package!r} has no component that takes part in training",
            expected=f"one of the slots {listed(slots.values())}",
            found=listed(f"{singular(entry.slot)} {entry.name}" for entry in own),
            todo="`crossgrad plugins check` checks the components of the other slots",
        )
    names: dict[str, tuple[str, ...]] = {}
    left_out: list[str] = []
    for slot, group in slots.items():
        able = []
        for entry in offers(group):
            reason = _cannot_be_combined(entry)
            if reason and entry in taking_part:
                raise UserError(
                    f"{slot} {entry.name} cannot be combined with others",
                    where=entry.origin,
                    found=reason,
                    todo=f"`crossgrad plugins check {package}` says more",
                )
            if reason:
                left_out.append(f"{slot} {entry.name}: {reason}")
            else:
                able.append(entry.name)
        names[slot] = tuple(sorted(able))
    ours = frozenset((singular(entry.slot), entry.name) for entry in taking_part)
    origin = f"{own[0].distribution} {own[0].version}"
    return Members(origin, names, ours, tuple(left_out))


def _cannot_be_combined(entry: Entry) -> str:
    """Why a component is left out; empty where it is not."""
    if [each.name for each in offers(entry.slot)].count(entry.name) > 1:
        return "two packages offer that name"
    try:
        loaded = load_entry(entry)
    except UserError as error:
        return error.found or error.what
    if issubclass(loaded, Rasterizer) and not _runs_here(loaded):
        return f"it runs on {listed(sorted(loaded.devices))}, not on this machine"
    return ""


def _runs_here(rasterizer: type[Rasterizer]) -> bool:
    import torch

    on_gpu = torch.cuda.is_available() and rasterizer.speed("cuda") > 0.0
    return "cpu" in rasterizer.devices or on_gpu


def combinations_of(members: Members, admits: Admits, *, full: bool) -> Iterator[Factors]:
    """The combinations to train: those of the five slots, then those of each further slot.

    Args:
        members: What takes part.
        admits: Asked of every combination that is wanted.
        full: All combinations with a component of the package; otherwise as few as bring each of
            these together with every component of the other slots that it can work with.
    """
    ours = sorted((SLOTS.index(slot), name) for slot, name in members.own if slot in SLOTS)
    if ours:
        rows = _all_of(members, set(ours)) if full else _few_of(members, SLOTS, ours, admits)
        yield Factors(SLOTS, tuple(rows))
    for slot, name in sorted(each for each in members.own if each[0] in FURTHER):
        slots, place = (*SLOTS, slot), (len(SLOTS), name)
        if full:
            rows = ((*row, name) for row in every_row(members.names))
        else:
            rows = _few_of(members, slots, [place], admits)
        yield Factors(slots, tuple(rows))


def _all_of(members: Members, ours: set[tuple[int, str]]) -> Iterator[Row]:
    """Every combination of the five slots with a component of the package."""
    return (row for row in every_row(members.names) if ours.intersection(enumerate(row)))


def _few_of(
    members: Members, slots: tuple[str, ...], ours: list[tuple[int, str]], admits: Admits
) -> Iterator[Row]:
    """Combinations in which each component of the package meets all others that it works with."""
    values = [members.names[slot] for slot in slots[: len(SLOTS)]]
    values += [(name,) for _, name in ours[: len(slots) - len(SLOTS)]]

    def usual(given: Mapping[int, str]) -> Row:
        return default_row({slots[place]: name for place, name in given.items()}, slots)

    known: set[Row] = set()
    for place, name in ours:
        for row in meetings(place, name, values, usual, lambda row: admits(row, slots)):
            if row not in known:
                known.add(row)
                yield row
