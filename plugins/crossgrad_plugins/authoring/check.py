"""`crossgrad plugins check`: the report about a package's plugins."""

from collections.abc import Sequence
from textwrap import fill

from crossgrad_core.commands import (
    GROUPS,
    OFFERED,
    Entry,
    Stray,
    UserError,
    did_you_mean,
    offers,
    sentences,
    singular,
    strays,
)
from crossgrad_core.testing.checking import Result, check_entry

_WIDTH = 80
_INDENT = " " * 6


def check_package(package: str) -> tuple[str, bool]:
    """Check every plugin of a package.

    Args:
        package: Name of a distribution, or of an import package that holds plugins.

    Returns:
        The report in 80 columns, and True if every check passed.

    Raises:
        UserError: No such package is installed, or it offers no plugin.
    """
    plugins, lost = entries_of(package), _strays_of(package)
    origins = sorted({f"{entry.distribution} {entry.version}" for entry in plugins})
    lines, failed = [", ".join(origins)], 0
    width = max(len(_label(entry)) for entry in plugins)
    for entry in plugins:
        results = check_entry(entry)
        failures = [result for result in results if result.failure is not None]
        failed += bool(failures)
        lines.append(f"  {_label(entry):<{width}}  {_verdict(results, failures)}")
        lines += [_reason(result) for result in failures]
    total = len(plugins) + len(lost)
    for stray in lost:
        lines += [
            f"  {stray.name}  FAIL",
            _reason(Result("the plugin is never read", stray.reason)),
        ]
    failed += len(lost)
    lines.append(f"{total - failed} of {total} plugins fulfil the contract of their slot")
    return "\n".join(lines), failed == 0


def _strays_of(package: str) -> list[Stray]:
    """Return the entry points of a package whose group does not exist."""
    return [stray for stray in strays() if _normalized(stray.distribution) == _normalized(package)]


def entries_of(package: str) -> list[Entry]:
    """Return the plugins of a package by slot and name.

    Raises:
        UserError: The same conditions as in `check_package`.
    """
    offered = [entry for slot in OFFERED for entry in offers(slot)]
    plugins = [entry for entry in offered if package in _names_of(entry)]
    plugins = plugins or [
        entry for entry in offered if _normalized(package) == _normalized(entry.distribution)
    ]
    if plugins:
        return plugins
    packages = sorted({entry.distribution for entry in offered})
    if _is_installed(package):
        raise UserError(
            f"package {package!r} contains no plugins",
            expected=f"entry points in a group such as {GROUPS['operators']}",
            found=sentences(*(f"{stray.name}: {stray.reason}" for stray in _strays_of(package))),
            todo="declare the plugins in pyproject.toml (docs/plugins.md) and install the "
            "package again",
        )
    raise UserError(
        f"no package named {package!r} is installed",
        expected=f"a package such as {', '.join(packages)}",
        todo=sentences(
            did_you_mean(package, packages), "install it into this environment with pip"
        ),
    )


def _names_of(entry: Entry) -> tuple[str, str]:
    """Return the distribution and the import package of an entry."""
    return entry.distribution, entry.package


def _normalized(name: str) -> str:
    """Normalize a distribution's name as pip does."""
    return name.lower().replace("_", "-").replace(".", "-")


def _is_installed(package: str) -> bool:
    from importlib.metadata import PackageNotFoundError, distribution
    from importlib.util import find_spec

    try:
        distribution(package)
    except (PackageNotFoundError, ValueError):
        return package.isidentifier() and find_spec(package) is not None
    return True


def _label(entry: Entry) -> str:
    return f"{singular(entry.slot)} {entry.name}"


def _verdict(results: Sequence[Result], failures: Sequence[Result]) -> str:
    skipped = sum(result.skipped is not None for result in results)
    note = f", {skipped} do not apply" if skipped else ""
    run = len(results) - skipped
    if failures:
        return f"FAIL  {len(failures)} of {run} checks{note}"
    return f"pass  {run} checks{note}"


def _reason(result: Result) -> str:
    """Return `check: reason`, wrapped and indented, and the location on a separate line.

    The location is not wrapped, so that it can be clicked and copied.
    """
    text = f"{result.check}: {result.failure}"
    reason = fill(
        text, _WIDTH, initial_indent="    - ", subsequent_indent=_INDENT, break_long_words=False
    )
    return f"{reason}\n{_INDENT}at {result.where}" if result.where else reason
