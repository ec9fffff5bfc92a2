"""The slots that plugins fill, their entry-point groups, and entry points in unknown groups.

This module imports no large package.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from crossgrad_core.wording import plural

#: Slot name -> entry-point group.
GROUPS: Final[dict[str, str]] = {
    slot: f"crossgrad.{slot}"
    for slot in (
        "backbones",
        "samplers",
        "groupings",
        "operators",
        "densifiers",
        "rasterizers",
        "losses",
        "exposures",
        "initializers",
        "resolutions",
        "readers",
        "exporters",
        "metrics",
        "observers",
        "recipes",
        "rules",
    )
}
#: Slots that a run fills with a list of components.
LISTS: Final = ("metrics", "observers")
#: Slots that a run fills with any number of components. The setting `rules` is a mapping from names
#: to options.
MANY: Final = (*LISTS, "rules")
#: The group of commands that packages add to `crossgrad`. This group is not a slot of a run.
COMMANDS: Final = "commands"
#: Name of a slot, or `commands` -> entry-point group.
OFFERED: Final[dict[str, str]] = {**GROUPS, COMMANDS: f"crossgrad.{COMMANDS}"}
#: The group of planners, which decide settings of a run from its scene (`--plan`). This group is
#: not a slot of a run.
PLANNERS: Final = "planners"
#: Slot -> entry-point group of functions that `auto` calls without importing a component. The
#: functions replace `accepts` of a reader and `speed` of a rasterizer.
QUICK: Final = {
    "readers": "crossgrad.readers.accepts",
    "rasterizers": "crossgrad.rasterizers.speed",
}
#: The core's own commands. A plugin cannot replace these commands.
OWN_COMMANDS: Final = ("run", "eval", "render", "export")
_KNOWN: Final = (*OFFERED.values(), *QUICK.values(), f"crossgrad.{PLANNERS}")
_PREFIX: Final = "crossgrad"
#: A group without the prefix `crossgrad` counts as misspelt if its similarity to a known group is
#: above this value.
_ALIKE: Final = 0.85


@dataclass(frozen=True)
class Stray:
    """An entry point that crossgrad never reads.

    Attributes:
        name: Name of the entry point.
        group: The group of the entry point.
        meant: The group that is probably meant; empty if no group is similar.
        distribution: Name of the distribution.
        version: Version of the distribution.
    """

    name: str
    group: str
    meant: str
    distribution: str
    version: str

    @property
    def origin(self) -> str:
        """The distribution and its version."""
        return f"{self.distribution} {self.version}"

    @property
    def reason(self) -> str:
        """The reason why the entry point is not read, and a remedy."""
        right = f"write {self.meant}" if self.meant else f"the groups are {', '.join(_KNOWN)}"
        return f"the entry-point group {self.group} does not exist: {right}"


def strays() -> Iterator[Stray]:
    """Yield the entry points of installed distributions that are in unknown crossgrad groups."""
    from importlib.metadata import entry_points

    points = entry_points()
    for group in sorted(points.groups):
        if group not in _KNOWN and _is_like_ours(group):
            for point in sorted(
                points.select(group=group), key=lambda entry_point: entry_point.name
            ):
                dist = point.dist
                origin = ("unknown", "unknown") if dist is None else (dist.name, dist.version)
                yield Stray(point.name, group, _meant(group), *origin)


def _is_like_ours(group: str) -> bool:
    from difflib import get_close_matches

    return group.lower().startswith(_PREFIX) or bool(get_close_matches(group, _KNOWN, 1, _ALIKE))


def _meant(group: str) -> str:
    """Return the known group that an unknown group probably means; empty if none is similar."""
    from difflib import get_close_matches

    slot = plural(group.lower().removeprefix(_PREFIX).strip("._-:"))
    if slot in OFFERED:
        return OFFERED[slot]
    return next(iter(get_close_matches(group.lower(), _KNOWN, 1)), "")
