"""The versions of crossgrad that the package of a plugin requires."""

from typing import Final

from crossgrad_core.system.version import VERSION

#: Name of crossgrad in the requirements of packages.
CROSSGRAD: Final = "crossgrad"


def unmet_requirement(distribution: str) -> str:
    """Return a distribution's requirement on crossgrad if it excludes this version; else empty."""
    if distribution == CROSSGRAD:
        return ""
    from importlib.metadata import PackageNotFoundError, requires

    try:
        lines = requires(distribution) or []
    except (PackageNotFoundError, ValueError):
        return ""
    # Parse only requirements that begin with `crossgrad`, because parsing all requirements would
    # take longer.
    return next(filter(None, map(_refusing, filter(_may_be_ours, lines))), "")


def _may_be_ours(line: str) -> bool:
    return line.lstrip().lower().startswith(CROSSGRAD)


def _refusing(line: str) -> str:
    """Return the requirement in a line of metadata if it excludes this version of crossgrad."""
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
