"""The components in the matrix of a package, and their combinations."""

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

#: Function that returns True if a combination of components can be trained.
Admits = Callable[[Row, tuple[str, ...]], bool]


@dataclass(frozen=True)
class Members:
    """The components that are combined.

    Attributes:
        package: Name and version of the package.
        names: Slot -> the names of all installed components that can be combined.
        own: (slot, name) of each component that belongs to the package.
        left_out: Components of other packages that cannot be combined, with the reason.
    """

    package: str
    names: Mapping[str, tuple[str, ...]]
    own: frozenset[tuple[str, str]]
    left_out: tuple[str, ...]


def members_of(package: str) -> Members:
    """Find the components of a package, and all other installed components.

    Raises:
        UserError: There is no such package, no component of the package takes part in training, or
            a component cannot be combined, for example because it cannot be loaded.
    """
    plugins = entries_of(package)
    slots = {slot: plural(slot) for slot in (*SLOTS, *FURTHER)}
    taking_part = [entry for entry in plugins if entry.slot in slots.values()]
    if not taking_part:
        raise UserError(
            f"package {package!r} contains no component that is used in training",
            expected=f"a component for one of the slots {listed(slots.values())}",
            found=listed(f"{singular(entry.slot)} {entry.name}" for entry in plugins),
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
                    f"{slot} {entry.name} cannot be tested in combinations",
                    where=entry.origin,
                    found=reason,
                    todo=f"`crossgrad plugins check {package}` shows the reason",
                )
            if reason:
                left_out.append(f"{slot} {entry.name}: {reason}")
            else:
                able.append(entry.name)
        names[slot] = tuple(sorted(able))
    ours = frozenset((singular(entry.slot), entry.name) for entry in taking_part)
    origin = f"{plugins[0].distribution} {plugins[0].version}"
    return Members(origin, names, ours, tuple(left_out))


def _cannot_be_combined(entry: Entry) -> str:
    """Return the reason why a component cannot be combined, or an empty text."""
    if [offer.name for offer in offers(entry.slot)].count(entry.name) > 1:
        return "two packages offer this name"
    try:
        loaded = load_entry(entry)
    except UserError as error:
        return error.found or error.what
    if issubclass(loaded, Rasterizer) and not _runs_here(loaded):
        return f"it runs only on {listed(sorted(loaded.devices))}, which this machine does not have"
    return ""


def _runs_here(rasterizer: type[Rasterizer]) -> bool:
    import torch

    on_gpu = torch.cuda.is_available() and rasterizer.speed("cuda") > 0.0
    return "cpu" in rasterizer.devices or on_gpu


def combinations_of(members: Members, admits: Admits, *, full: bool) -> Iterator[Factors]:
    """Yield the combinations to train: first of the five slots, then with each further slot.

    Args:
        members: The components that are combined.
        admits: Function that returns True if a requested combination can be trained.
        full: True for all combinations that contain a component of the package. False for the
            fewest combinations in which each component of the package occurs with every compatible
            component of the other slots.
    """
    ours = sorted((SLOTS.index(slot), name) for slot, name in members.own if slot in SLOTS)
    if ours:
        rows = _all_of(members, set(ours)) if full else _few_of(members, SLOTS, ours, admits)
        yield Factors(SLOTS, tuple(rows))
    for slot, name in sorted(member for member in members.own if member[0] in FURTHER):
        slots, component = (*SLOTS, slot), (len(SLOTS), name)
        if full:
            rows = ((*row, name) for row in every_row(members.names))
        else:
            rows = _few_of(members, slots, [component], admits)
        yield Factors(slots, tuple(rows))


def _all_of(members: Members, ours: set[tuple[int, str]]) -> Iterator[Row]:
    """Return every combination of the five slots that contains a component of the package."""
    return (row for row in every_row(members.names) if ours.intersection(enumerate(row)))


def _few_of(
    members: Members, slots: tuple[str, ...], ours: list[tuple[int, str]], admits: Admits
) -> Iterator[Row]:
    """Yield few combinations.

    Each component of the package occurs with every compatible component.
    """
    values = [members.names[slot] for slot in slots[: len(SLOTS)]]
    values += [(name,) for _, name in ours[: len(slots) - len(SLOTS)]]

    def usual(given: Mapping[int, str]) -> Row:
        return default_row({slots[position]: name for position, name in given.items()}, slots)

    yielded: set[Row] = set()
    for position, name in ours:
        for row in meetings(position, name, values, usual, lambda row: admits(row, slots)):
            if row not in yielded:
                yielded.add(row)
                yield row
