"""`crossgrad plugins matrix`: train the combinations of a package and report the results."""

import traceback
from dataclasses import dataclass, field
from textwrap import fill

from crossgrad_core.commands import Progress, UserError, count, listed
from crossgrad_core.testing.support.short_runs import reasons_to_refuse, try_out
from crossgrad_plugins.authoring.matrix.combinations import (
    FURTHER,
    SLOTS,
    STEPS,
    Refused,
    Row,
    as_lines,
    config_of,
    named,
)
from crossgrad_plugins.authoring.matrix.members import Members, combinations_of, members_of

_WIDTH = 80
#: Seconds between two lines of progress.
_PAUSE = 5.0


@dataclass
class Tally:
    """The combinations that were trained, refused or failed.

    Attributes:
        members: The components that are combined.
        trained: Combination -> (slot, name) of each component in it.
        refused: Slots -> combination that contains a component of the package -> reasons.
        failed: Combination as text -> reason of its failure.
    """

    members: Members
    trained: list[frozenset[tuple[str, str]]] = field(default_factory=list)
    refused: dict[tuple[str, ...], dict[Row, tuple[str, ...]]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def admits(self, row: Row, slots: tuple[str, ...]) -> bool:
        """Return True if a run of the combination can start; otherwise, record the reasons.

        An unexpected error is not recorded here, because training raises and records it again.
        """
        try:
            reasons = reasons_to_refuse(config_of(row, slots))
        except (Exception, SystemExit):
            return True
        if reasons and self.members.own.intersection(zip(slots, row, strict=True)):
            self.refused.setdefault(slots, {})[row] = reasons
        return not reasons

    def train(self, row: Row, slots: tuple[str, ...]) -> None:
        """Train a combination and record the result."""
        try:
            try_out(config_of(row, slots), STEPS)
        except (Exception, SystemExit) as error:
            self.failed[named(row, slots)] = reason_of(error)
        self.trained.append(frozenset(zip(slots, row, strict=True)))

    @property
    def never_trained(self) -> list[str]:
        """Components of the package that were refused in every combination."""
        met = frozenset().union(*self.trained)
        return [f"{slot} {name}" for slot, name in sorted(self.members.own - met)]


def reason_of(error: BaseException) -> str:
    """Return an error in one line, with the source line that raised it."""
    text = f"{error.what}: {error.found}" if isinstance(error, UserError) else str(error)
    frames = traceback.extract_tb(error.__traceback__)
    source_line = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {' '.join(text.split())}{source_line}"


def train_matrix(package: str, *, full: bool) -> tuple[str, bool]:
    """Train a package's components with all other components.

    Args:
        package: Name of a distribution, or of an import package that holds plugins.
        full: True for all combinations; False for few combinations that contain every pair.

    Returns:
        The report in 80 columns, and True if no combination failed.

    Raises:
        UserError: The same conditions as in `members_of`.
    """
    tally = Tally(members_of(package))
    progress = Progress(_PAUSE)
    progress.tell("choosing combinations")
    designs = tuple(combinations_of(tally.members, tally.admits, full=full))
    total = sum(len(design.rows) for design in designs)
    done = 0
    for design in designs:
        for row in design.rows:
            done += 1
            progress.tell(f"combination {done} of {total}")
            if not full or tally.admits(row, design.slots):
                tally.train(row, design.slots)
    return report(tally, package), not tally.failed and not tally.never_trained


def train_one(package: str, combination: str) -> None:
    """Train a single combination, and let its errors propagate.

    Args:
        package: Name of the package.
        combination: The text `slot=name slot=name` that the report shows.

    Raises:
        UserError: The format is invalid, or a component is not installed.
    """
    members = members_of(package)
    pairs = [tuple(word.split("=", 1)) for word in combination.split()]
    slots = tuple(pair[0] for pair in pairs)
    installed = all(len(pair) == 2 and pair[1] in members.names.get(pair[0], ()) for pair in pairs)  # noqa: PLR2004
    if not installed or slots[: len(SLOTS)] != SLOTS or not set(slots[len(SLOTS) :]) <= {*FURTHER}:
        raise UserError(
            "the text does not name a combination of components",
            where="--only",
            expected=f"{' '.join(f'{slot}=NAME' for slot in SLOTS)}, as the report shows it",
            found=combination,
            todo="copy a combination from the report of the matrix",
        )
    try_out(config_of(tuple(pair[1] for pair in pairs), slots), STEPS)


def report(tally: Tally, package: str) -> str:
    """Return the report on trained, refused and failed combinations, in 80 columns."""
    members, components = tally.members, tally.members.own
    heading = f"{members.package}: {listed(f'{slot} {name}' for slot, name in sorted(components))}"
    numbers = count(len(tally.trained) - len(tally.failed), "combination")
    lines = [_filled(heading, ""), f"{numbers} trained for {STEPS} steps, twice with the same bits"]
    lines += [_filled(f"left out: {reason}", "  ") for reason in members.left_out]
    refused = sum(map(len, tally.refused.values()))
    lines.append(f"{count(refused, 'combination')} refused before training, with a reason")
    for slots, rows in tally.refused.items():
        lines += [_filled(line, "  ") for line in _refusals(rows, slots, tally)]
    lines += [
        f"FAIL  {name} was not trained in any combination: all were refused"
        for name in tally.never_trained
    ]
    lines.append(f"{count(len(tally.failed), 'combination')} failed")
    for combination, reason in tally.failed.items():
        lines += [f"  {combination}", _filled(reason, "    ")]
        lines.append(f"    crossgrad plugins matrix {package} --only '{combination}'")
    return "\n".join(lines)


def _refusals(rows: Refused, slots: tuple[str, ...], tally: Tally) -> list[str]:
    """Summarise the refused combinations in few lines that match no trained combination."""
    wanted = set(slots)
    trained = [pairs for pairs in tally.trained if {slot for slot, _ in pairs} == wanted]
    names = [dict(pairs) for pairs in trained]
    return as_lines(rows, [*rows, *(tuple(row[slot] for slot in slots) for row in names)], slots)


def _filled(text: str, indent: str) -> str:
    return fill(
        text,
        _WIDTH,
        initial_indent=indent,
        subsequent_indent=f"{indent}  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
