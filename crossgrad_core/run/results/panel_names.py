"""File names for renders, and which views get one."""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crossgrad_core.contract.scene import View

_UNSAFE = re.compile(r"[^\w.+-]+")
_LONGEST = 120  # bytes


def flat_names(names: Sequence[str]) -> dict[str, str]:
    """View name -> file name without folders and suffix, unique even where case does not count.

    `aerial/0001.jpg` becomes `aerial__0001`; what would clash gets -2, -3 and so on.
    """
    flat: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        path = PurePosixPath(name)
        parts = [part for part in path.with_suffix("").parts if part not in {"..", "/"}]
        base = ending(_UNSAFE.sub("_", "__".join(parts)).strip(".")) or "view"
        unique, number = base, 1
        while unique.casefold() in taken:
            number += 1
            unique = f"{base}-{number}"
        taken.add(unique.casefold())
        flat[name] = unique
    return flat


def ending(name: str) -> str:
    """The end of a name that is too long to be a part of another one."""
    return name.encode()[-_LONGEST:].decode(errors="ignore")


def chosen_views(views: "Sequence[View]", count: int) -> "tuple[View, ...]":
    """`count` views, or all: every regime in turn, evenly spread over each regime's views."""
    regimes = sorted({view.regime for view in views})
    groups = [[view for view in views if view.regime == regime] for regime in regimes]
    share = [0] * len(groups)
    for _ in range(min(count, len(views))):
        # The first of those that have the fewest so far, and one more.
        unused = [i for i, group in enumerate(groups) if share[i] < len(group)]
        share[min(unused, key=share.__getitem__)] += 1
    chosen = {
        view.name
        for group, wanted in zip(groups, share, strict=True)
        for view in _spread(group, wanted)
    }
    return tuple(view for view in views if view.name in chosen)


def _spread(group: "Sequence[View]", wanted: int) -> "list[View]":
    wanted = min(wanted, len(group))
    return [group[(2 * i + 1) * len(group) // (2 * wanted)] for i in range(wanted)]
