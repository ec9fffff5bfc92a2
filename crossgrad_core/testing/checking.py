"""Running the contract checks of a slot on an installed plugin and collecting what they find."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias
from unittest import SkipTest

from crossgrad_core import registry
from crossgrad_core.errors import UserError
from crossgrad_core.wording import in_one_line, singular

#: `check(make)`, see `crossgrad_core.testing.contract`; of any slot.
AnyCheck: TypeAlias = Callable[[Any], None]


@dataclass(frozen=True)
class Result:
    """What one check of one plugin found.

    Attributes:
        check: Name of the check.
        failure: Why it failed; None where it passed.
        skipped: Why it does not apply; None where it does.
    """

    check: str
    failure: str | None = None
    skipped: str | None = None


def checks_of(slot: str) -> tuple[AnyCheck, ...]:
    """The contract checks of a slot; imports no other slot's."""
    module = import_module(f"crossgrad_core.testing.{slot}")
    checks: tuple[AnyCheck, ...] = getattr(module, f"{singular(slot).upper()}_CHECKS")
    return checks


def check_entry(entry: registry.Entry) -> list[Result]:
    """Loads a plugin and runs every check of its slot; stops early where it cannot be loaded."""
    try:
        component = registry.load_entry(entry)
    except UserError as error:
        return [Result("it can be loaded", failure=f"{error.found or error.what}")]
    try:
        component()
    except Exception as error:
        return [Result("it can be made with default options", failure=in_one_line(error))]
    return [_result(check, component) for check in checks_of(entry.slot)]


def _result(check: AnyCheck, component: Callable[[], Any]) -> Result:
    name = check.__name__.replace("_", " ")
    try:
        check(component)
    except SkipTest as reason:
        return Result(name, skipped=str(reason))
    except AssertionError as error:
        return Result(name, failure=str(error) or "an assertion without a text failed")
    except Exception as error:
        return Result(name, failure=in_one_line(error))
    return Result(name)
