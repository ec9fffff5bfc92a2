"""The table of a plan on a terminal of any width."""

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from textwrap import wrap
from typing import Final

from crossgrad_plugins.planner.decision import Decision
from crossgrad_plugins.planner.planner import Plan

#: Below this width the cost and the option of a part stand below its evidence.
_WIDE: Final = 110
_HEADER: Final = ("part", "decision", "evidence", "cost saved", "force with")
#: Columns of a wide table without the evidence, which has the rest.
_WIDTHS: Final = (14, 20, 0, 18, 23)
_GAP: Final = "  "
#: What is added to a choice that the evidence did not make.
_MARKS: Final = {"decided": "", "default": " (default)", "given": " (yours)"}


def lines_of(plan: Plan, width: int) -> Iterator[str]:
    """The table, and what it means, in lines of at most `width` characters."""
    rows = [_HEADER, *(map(_cells, plan.decisions))]
    for row in rows:
        yield from _wide(row, width) if width >= _WIDE else _narrow(row, width)
        if row is _HEADER or width < _WIDE:
            yield ""
    if width >= _WIDE:
        yield ""
    changed = [f"{name} = {value}" for name, value in plan.settings.items()]
    told = f"changed: {', '.join(changed)}" if changed else "nothing is changed"
    yield from wrap(f"{told}; default: the evidence is missing or undecided", width)
    yield f"decided in {plan.seconds:.1f} s"


def _cells(decision: Decision) -> tuple[str, ...]:
    choice = f"{decision.choice}{_MARKS[decision.basis]}"
    return (decision.part, choice, decision.evidence, decision.saved, decision.force)


def _wide(row: Sequence[str], width: int) -> Iterator[str]:
    """A row in columns, each cell wrapped."""
    rest = width - sum(_WIDTHS) - len(_GAP) * (len(_WIDTHS) - 1)
    widths = [each or rest for each in _WIDTHS]
    cells = [_wrapped(text, space) for text, space in zip(row, widths, strict=True)]
    for parts in zip_longest(*cells, fillvalue=""):
        padded = (part.ljust(space) for part, space in zip(parts, widths, strict=True))
        yield _GAP.join(padded).rstrip()


def _narrow(row: Sequence[str], width: int) -> Iterator[str]:
    """A row as a block: part and decision, below them the evidence, the cost and the option."""
    part, choice, *below = row
    indent = " " * (_WIDTHS[0] + len(_GAP))
    yield f"{part.ljust(_WIDTHS[0])}{_GAP}{choice}"
    if row is _HEADER:
        yield indent + ", ".join(below)
        return
    evidence, saved, force = below
    for text in (evidence, f"saves {saved}" if saved != "-" else "", f"force with {force}"):
        yield from (indent + line for line in _wrapped(text, width - len(indent)) if line)


def _wrapped(text: str, width: int) -> list[str]:
    return wrap(text, max(1, width), break_on_hyphens=False) or [""]
