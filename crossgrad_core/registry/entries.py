"""Plugins by name: listed from package metadata, imported only when a run needs them.

Listing reads entry points and imports no plugin, no torch and no pydantic. Loading never fails
silently. Loading raises an error if a name is unknown, if two distributions offer the name, if the
plugin cannot be imported, or if the plugin has a wrong type. The error names the plugin and its
distribution.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from importlib import import_module
from inspect import isabstract
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast, overload

from crossgrad_core.errors import UserError
from crossgrad_core.registry.requirements import unmet_requirement
from crossgrad_core.registry.signatures import defined_at, raised_at, wrong_signatures
from crossgrad_core.registry.slots import COMMANDS, GROUPS, MANY, OFFERED, PLANNERS, QUICK, strays
from crossgrad_core.system.version import VERSION
from crossgrad_core.wording import (
    did_you_mean,
    in_one_line,
    listed,
    sentences,
    singular,
    with_article,
)

if TYPE_CHECKING:
    from importlib.metadata import Distribution

    from crossgrad_core.contract.component import Component

    #: The base class of a slot.
    C = TypeVar("C", bound=Component)


#: The distribution of crossgrad's own plugins.
OURS: Final = "crossgrad"


@dataclass(frozen=True)
class Entry:
    """An installed plugin, as described by the entry point in its distribution.

    Attributes:
        name: The name that users type.
        slot: Slot that the plugin fills, a key of `OFFERED`, or `planners`.
        value: The location of the plugin's class: `module:Class`.
        distribution: Name of the distribution that offers the plugin.
        version: Version of this distribution.
    """

    name: str
    slot: str
    value: str
    distribution: str
    version: str

    @property
    def package(self) -> str:
        """The import package or module that contains the plugin's class."""
        return self.value.partition(":")[0].partition(".")[0].strip()

    @property
    def file(self) -> str | None:
        """The source file of the plugin's module; None before the module is imported."""
        return getattr(sys.modules.get(self.value.partition(":")[0].strip()), "__file__", None)

    @property
    def origin(self) -> str:
        """The location of the plugin's class and its distribution, for messages."""
        return f"{self.value}, from {self.distribution} {self.version}"


def offers(slot: str) -> tuple[Entry, ...]:
    """Return all installed entries of a slot, sorted by name; a name may occur twice.

    Raises:
        KeyError: The slot does not exist.
    """
    return _offers(tuple(sys.path))[slot]


def entries(slot: str) -> dict[str, Entry]:
    """Return name -> entry for a slot. No plugin is imported.

    Raises:
        KeyError: The slot does not exist.
    """
    return {entry.name: entry for entry in offers(slot)}


def find(slot: str, name: str) -> Entry:
    """Return the only entry of a slot with the name `name`.

    Raises:
        UserError: No distribution offers the name, or several distributions offer it.
    """
    named = [entry for entry in offers(slot) if entry.name == name]
    if not named:
        raise _unknown(slot, name)
    if len(named) > 1:
        others = [entry.distribution for entry in named if entry.distribution != OURS]
        ours = len(others) < len(named)
        raise UserError(
            f"{len(named)} installed packages offer {with_article(singular(slot))} named {name!r}",
            where=singular(slot),
            expected="one package per name",
            found=listed(f"{entry.distribution} {entry.version}" for entry in named),
            todo=f"rename the plugin in {listed(others)}, or uninstall that package: the name "
            "belongs to crossgrad"
            if ours
            else "uninstall all of these packages except one",
        )
    return named[0]


@overload
def load(slot: "type[C]", name: str) -> "type[C]": ...
@overload
def load(slot: str, name: str) -> "type[Component]": ...
def load(slot: "str | type[Component]", name: str) -> "type[Component]":
    """Return the class of the component with this name; its module is imported first.

    Args:
        slot: Name of the slot, or base class of the slot; the returned class is a subclass of this
            base class.
        name: Name of the plugin.

    Raises:
        UserError: The name is unknown or ambiguous, or the plugin cannot be imported. Also if the
            plugin is not a complete subclass of the slot's base class, or if its methods take other
            arguments.
    """
    return load_entry(find(slot if isinstance(slot, str) else slot.slot, name))


def load_entry(entry: Entry) -> "type[Component]":
    """Return the class that an entry names (see `load`)."""
    return _checked(entry, resolve_entry(entry))


def resolve_entry(entry: Entry) -> object:
    """Return the object that an entry names; its module is imported first.

    Raises:
        UserError: The object cannot be imported, or its package requires another version of
            crossgrad.
    """
    refuse_other_version(entry)
    try:
        return _resolve(entry.value)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        line = raised_at(error, entry.package)
        others = COMMANDS if entry.slot == COMMANDS else "runs"
        raise UserError(
            f"{singular(entry.slot)} {entry.name} cannot be imported",
            where=sentences(entry.origin, line),
            found=in_one_line(error),
            todo=f"repair or uninstall {entry.distribution}; other {others} still work",
        ) from error


def refuse_other_version(entry: Entry) -> None:
    """Refuse a plugin whose package requires another version of crossgrad than this one.

    Raises:
        UserError: The package requires another version; the message names the package and the
            requirement.
    """
    if required := unmet_requirement(entry.distribution):
        raise UserError(
            f"{singular(entry.slot)} {entry.name} was written for another version of crossgrad",
            where=entry.origin,
            expected=f"{required}, which {entry.distribution} {entry.version} requires",
            found=f"{OURS} {VERSION}",
            todo=f"install a version of {entry.distribution} for {OURS} {VERSION}, or install "
            f"'{required}'",
        )


def notes_on(error: BaseException) -> list[str]:
    """Return the notes on the step, hook and plugin in which an exception was raised."""
    # The hook adds its note before the step does. Reverse the notes, so that the note on the step
    # comes first.
    return list(reversed(getattr(error, "__notes__", ())))


def quick_answer(entry: Entry) -> Callable[[Any], Any] | None:
    """Return a function that replaces a component's method and imports no component; or None.

    A package may define such a function in an entry point with the name of the component. The
    function returns the same result as `accepts` of a reader with default options, or as `speed` of
    a rasterizer.

    Raises:
        UserError: The function cannot be imported.
    """
    for announced in _offers(tuple(sys.path))[QUICK[entry.slot]]:
        if (announced.name, announced.distribution) == (entry.name, entry.distribution):
            return cast("Callable[[Any], Any]", resolve_entry(announced))
    return None


def failed_plugin(error: Exception) -> UserError | None:
    """Return a user error for an exception that a plugin of another package raised; else None."""
    others = (entry for slot in OFFERED for entry in offers(slot) if entry.distribution != OURS)
    raising = [(entry, line) for entry in others if (line := raised_at(error, entry.package))]
    if not raising:
        return None
    # If two distributions share a package, prefer the distribution that contains the module.
    entry, line = next((one for one in raising if one[1].startswith(f"{one[0].file}:")), raising[0])
    return UserError(
        f"a plugin of package {entry.distribution} {entry.version} raised an error",
        where=sentences(*notes_on(error), line),
        found=in_one_line(error),
        todo=f"repair or uninstall {entry.distribution}, or choose other components",
    )


def from_elsewhere(names: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return a note about each distribution, except crossgrad, that provides one of the components.

    Args:
        names: Slot -> names of components.
    """
    chosen = (entries(slot).get(name) for slot, several in names.items() for name in several)
    by_origin: dict[str, list[str]] = {}
    for entry in chosen:
        if entry is not None and entry.distribution != OURS:
            origin = f"{entry.distribution} {entry.version}"
            by_origin.setdefault(origin, []).append(f"{singular(entry.slot)} {entry.name}")
    return tuple(
        f"from {origin}: {listed(components)}" for origin, components in sorted(by_origin.items())
    )


@overload
def build(slot: "type[C]", name: str, options: Mapping[str, Any]) -> "C": ...
@overload
def build(slot: str, name: str, options: Mapping[str, Any]) -> "Component": ...
def build(slot: "str | type[Component]", name: str, options: Mapping[str, Any]) -> "Component":
    """Return the component of that name with validated options.

    Args:
        slot: Name of the slot, or base class of the slot; the returned component is an instance of
            this class.
        name: Name of the plugin.
        options: Name of an option -> value.

    Raises:
        UserError: An option is unknown, missing or out of bounds; see also `load`.
    """
    from pydantic import ValidationError

    from crossgrad_core.registry.validation import as_user_error

    component = load(slot, name)
    slot = component.slot
    word = singular(slot)
    try:
        return component.model_validate(dict(options))
    except ValidationError as error:
        raise as_user_error(
            error,
            component,
            subject=f"{word} {name}",
            prefix=f"{slot}.{name}" if slot in MANY else word,
            todo=f"`crossgrad plugins show {name}` explains the options",
        ) from None


def installed_as(kind: "type[Component]") -> Entry | None:
    """Return the entry of a class; None if no package offers the class."""
    package = kind.__module__.partition(".")[0]
    for entry in entries(kind.slot).values():
        module, _, attribute = entry.value.partition(":")
        # Do not import the module of another package to find a class with the same name.
        alike = attribute.strip() == kind.__qualname__ and entry.package == package
        if alike and (module.strip() == kind.__module__ or resolve_entry(entry) is kind):
            return entry
    return None


def name_of(component: "Component") -> str:
    """Return the name under which a component is installed, else the name of its class."""
    kind = type(component)
    entry = installed_as(kind)
    return kind.__name__ if entry is None else entry.name


def plain(component: "Component") -> dict[str, Any]:
    """Return a component as in a configuration: its name and the options that are not defaults."""
    return {"name": name_of(component), **component.model_dump(mode="json", exclude_defaults=True)}


@cache
def _offers(path: tuple[str, ...]) -> dict[str, tuple[Entry, ...]]:  # noqa: ARG001 - cache key
    """Return slot -> entries; the argument is `sys.path`, so a changed path causes a new scan."""
    from importlib.metadata import entry_points

    # Call `entry_points` once and without a filter, because each call scans every installed
    # distribution.
    points = entry_points()
    offers_by_slot: dict[str, tuple[Entry, ...]] = {}
    groups = [*OFFERED.items(), (PLANNERS, f"crossgrad.{PLANNERS}")]
    for key, slot, group in [
        *((slot, slot, group) for slot, group in groups),
        *((group, slot, group) for slot, group in QUICK.items()),
    ]:
        described = (
            Entry(point.name, slot, point.value, *_identity(point.dist))
            for point in points.select(group=group)
        )
        offers_by_slot[key] = tuple(
            sorted(described, key=lambda entry: (entry.name, entry.distribution))
        )
    return offers_by_slot


@cache
def _identity(distribution: "Distribution | None") -> tuple[str, str]:
    """Return the name and version of a distribution; cached, because each access parses a file."""
    if distribution is None:
        return "unknown", "unknown"
    metadata = distribution.metadata
    return metadata["Name"], metadata["Version"]


def _unknown(slot: str, name: str) -> UserError:
    names = list(entries(slot))
    elsewhere = [other for other in GROUPS if other != slot and name in entries(other)]
    hint = (
        f"a component with the name {name} exists in the slot {singular(elsewhere[0])}"
        if elsewhere
        else did_you_mean(name, names)
    )
    for stray in strays():
        if stray.name == name:
            hint = f"{stray.origin} offers {name}, but {stray.reason}"
    return UserError(
        f"there is no {singular(slot)} named {name!r}",
        where=singular(slot),
        expected=f"one of {listed(names)}" if names else "an installed plugin; none is installed",
        todo=sentences(hint, f"`crossgrad plugins list --slot {slot}` lists them"),
    )


def _resolve(value: str) -> object:
    """Return the object at `module:attribute.attribute`."""
    module, _, attributes = value.partition(":")
    path = filter(None, attributes.split("."))
    return reduce(getattr, path, import_module(module.strip()))


def _checked(entry: Entry, component: object) -> "type[Component]":
    word = singular(entry.slot)
    base = cast(
        "type[Component]", _resolve(f"crossgrad_core.contract.slots.{word}:{word.capitalize()}")
    )
    if not (isinstance(component, type) and issubclass(component, base)):
        raise _wrong_kind(entry, base, f"{component!r}")
    if isabstract(component):
        missing = sorted(getattr(component, "__abstractmethods__", ()))
        raise _wrong_kind(
            entry, base, f"{component.__name__} without the methods {listed(missing)}"
        )
    for name, expected, given in wrong_signatures(component, base):
        raise UserError(
            f"{word} {entry.name} has a method with wrong arguments",
            where=sentences(entry.origin, defined_at(getattr(component, name))),
            expected=f"{name}{expected}",
            found=f"{name}{given}",
            todo=f"repair or uninstall {entry.distribution}",
        )
    return component


def _wrong_kind(entry: Entry, base: type, found: str) -> UserError:
    return UserError(
        f"{singular(entry.slot)} {entry.name} cannot be used",
        where=entry.origin,
        expected=f"a complete subclass of crossgrad_core.plugin.{base.__name__}",
        found=found,
        todo=f"repair or uninstall {entry.distribution}",
    )
