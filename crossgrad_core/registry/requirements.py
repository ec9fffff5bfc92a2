"""Which versions of crossgrad the package of a plugin says that it works with."""

from typing import TYPE_CHECKING

from crossgrad_core.errors import UserError
from crossgrad_core.system.version import VERSION
from crossgrad_core.wording import singular

if TYPE_CHECKING:
    from crossgrad_core.registry.entries import Entry

#: The name of the distribution that packages require.
CROSSGRAD = "crossgrad"


def refuse_other_version(entry: "Entry") -> None:
    """Refuses a plugin whose package requires another version of crossgrad than this one.

    Raises:
        UserError: It does; names the package and what it requires.
    """
    required = unmet_requirement(entry)
    if required:
        raise UserError(
            f"{singular(entry.slot)} {entry.name} is written for another version of crossgrad",
            where=entry.origin,
            expected=f"{required}, which {entry.distribution} {entry.version} requires",
            found=f"{CROSSGRAD} {VERSION}",
            todo=f"install a version of {entry.distribution} for {CROSSGRAD} {VERSION}, or install "
            f"'{required}'",
        )


def unmet_requirement(entry: "Entry") -> str:
    """What a plugin's package requires of crossgrad, if this version is another; else empty."""
    from importlib.metadata import PackageNotFoundError, requires

    if entry.distribution == CROSSGRAD:
        return ""
    try:
        lines = requires(entry.distribution) or []
    except (PackageNotFoundError, ValueError):
        return ""
    # Packages have many requirements, and few of them begin like this one.
    return next(filter(None, map(_refusing, filter(_may_be_ours, lines))), "")


def _may_be_ours(line: str) -> bool:
    return line.lstrip().lower().startswith(CROSSGRAD)


def _refusing(line: str) -> str:
    """The requirement in a line of metadata, if it excludes this version of crossgrad."""
    from packaging.requirements import InvalidRequirement, Requirement

    try:
        requirement = Requirement(line)
    except InvalidRequirement:
        return ""
    applies = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
    if requirement.name.lower() != CROSSGRAD or not applies:
        return ""
    met = requirement.specifier.contains(VERSION, prereleases=True)
    return "" if met else f"{CROSSGRAD}{requirement.specifier}"
