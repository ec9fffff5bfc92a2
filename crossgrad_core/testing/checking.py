"""Run the contract checks of a slot on an installed plugin, and return the results."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias
from unittest import SkipTest

from crossgrad_core.errors import UserError
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.commands import load_command
from crossgrad_core.registry.signatures import defined_at, raised_at
from crossgrad_core.registry.slots import COMMANDS, OWN_COMMANDS
from crossgrad_core.wording import in_one_line, listed, singular

#: A check of any slot: a function `check(make)`, described in
#: `crossgrad_core.testing.support.contract`.
AnyCheck: TypeAlias = Callable[[Any], None]


@dataclass(frozen=True)
class Result:
    """The result of one check on one plugin.

    Attributes:
        check: Name of the check.
        failure: Reason why the check failed; None for a check that passed.
        skipped: Reason why the check does not apply; None for a check that applies.
        where: `file:line` of the failure in the plugin. If the line is unknown, the entry point
            that registers the plugin.
    """

    check: str
    failure: str | None = None
    skipped: str | None = None
    where: str = ""


def checks_of(slot: str) -> tuple[AnyCheck, ...]:
    """Return the contract checks of a slot. Only the checks of this slot are imported."""
    module = import_module(f"crossgrad_core.testing.{slot}")
    checks: tuple[AnyCheck, ...] = getattr(module, f"{singular(slot).upper()}_CHECKS")
    return checks


def check_entry(entry: registry.Entry) -> list[Result]:
    """Load a plugin and run all checks of its slot.

    If the plugin cannot be loaded, return only a failed result for the loading.
    """
    taken = _taken(entry)
    names = (
        [Result("its name is not used by another plugin", failure=taken, where=entry.origin)]
        if taken
        else []
    )
    if taken and entry.slot == COMMANDS:
        # Users cannot call the plugin's command if the core has a command with this name, so the
        # command cannot be tested.
        return names
    try:
        loaded = load_command(entry) if entry.slot == COMMANDS else registry.load_entry(entry)
    except UserError as error:
        where = raised_at(error, entry.package) or _announced_at(entry)
        reasons = [
            error.found or error.what,
            *([f"not {error.expected}"] if error.expected else []),
        ]
        lost = Result("it can be loaded", failure=listed(reasons), where=where)
        return [*names, lost]
    if entry.slot == COMMANDS:
        where, package = _announced_at(entry), entry.package
    else:
        where, package = defined_at(loaded), loaded.__module__.partition(".")[0]
        try:
            loaded()
        except (Exception, SystemExit) as error:
            return [
                *names,
                _failed("it can be created with default options", error, package, where),
            ]
    return [*names, *(_result(check, loaded, package, where) for check in checks_of(entry.slot))]


def _taken(entry: registry.Entry) -> str:
    """Return the reason why users cannot choose the plugin by its name.

    The text is empty if users can choose the plugin.
    """
    if entry.slot == COMMANDS and entry.name in OWN_COMMANDS:
        return f"the core has a command {entry.name}, which is called instead"
    try:
        registry.find(entry.slot, entry.name)
    except UserError as error:
        return f"{error.what}: {error.found}"
    return ""


def _announced_at(entry: registry.Entry) -> str:
    """Return the source location of the object that an entry point names.

    Without a known location, return the file or the entry point.
    """
    module, _, name = entry.value.partition(":")
    loaded = sys.modules.get(module.strip())
    thing = getattr(loaded, name.strip(), None)
    # If another package defines the object, its location would not help the author of the plugin.
    location = defined_at(thing) if getattr(thing, "__module__", "") == module.strip() else ""
    return location or getattr(loaded, "__file__", None) or entry.origin


def _failed(check: str, error: BaseException, package: str, where: str) -> Result:
    """Return a failed result.

    The location of the failure is the innermost line of the package, or else `where`.
    """
    where = raised_at(error, package) or where
    if isinstance(error, AssertionError):
        return Result(check, str(error) or "an assertion without a message failed", where=where)
    return Result(check, in_one_line(error), where=where)


def _result(check: AnyCheck, subject: object, package: str, where: str) -> Result:
    name = check.__name__.replace("_", " ")
    try:
        check(subject)
    except SkipTest as reason:
        return Result(name, skipped=str(reason))
    except (Exception, SystemExit) as error:
        return _failed(name, error, package, where)
    return Result(name)
