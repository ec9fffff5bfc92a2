"""plugins.json: the packages that train a run, including crossgrad, and their versions."""

import json
import logging
from collections.abc import Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from crossgrad_core.contract.component import Component
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import OURS, Entry, entries, installed_as
from crossgrad_core.registry.slots import GROUPS
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.input_files import read_file
from crossgrad_core.system.version import VERSION
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import listed, plural, singular

FILE: Final = "plugins.json"
_LOG = logging.getLogger(__name__)


class Package(BaseModel):
    """A package that trains a run.

    Attributes:
        versions: The versions of the package that trained the run, in order of time.
        components: Components of the package in the run, such as `operator pcgrad`; empty for
            crossgrad.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    versions: tuple[str, ...] = Field(min_length=1)
    components: tuple[str, ...] = ()


#: Name of a package -> the package.
Packages: TypeAlias = dict[str, Package]
_PACKAGES: Final = TypeAdapter(Packages)


def packages_of(setup: Setup) -> Packages:
    """Return the packages of all components of a run, including nested components."""
    installed = [installed_as(type(component)) for component in _parts(setup.plugins)]
    installed.append(entries("readers").get(setup.selection.names["reader"]))
    packages = {OURS: Package(versions=(VERSION,))}
    foreign = [entry for entry in installed if entry is not None and entry.distribution != OURS]
    for entry in foreign:
        same = [other for other in foreign if other.distribution == entry.distribution]
        components = tuple(sorted({_described(other) for other in same}))
        packages[entry.distribution] = Package(versions=(entry.version,), components=components)
    return packages


def write_plugins(folder: Path, packages: Packages) -> None:
    """Write a run's plugins.json.

    Raises:
        UserError: The disk is full.
    """
    data = {name: package.model_dump(mode="json") for name, package in packages.items()}
    write_atomically(folder / FILE, f"{json.dumps(data, indent=1)}\n".encode())


def read_plugins(folder: Path, *, quiet: bool = False) -> Packages | None:
    """Return the packages that trained a run; if unknown, return None and log a warning."""
    path = folder / FILE
    try:
        return _PACKAGES.validate_json(read_file(path))
    except OSError:
        why = f"{folder} has no {FILE}: an older version wrote the run"
    except ValidationError:
        why = f"{path} is damaged, or another version wrote it"
    if not quiet:
        _LOG.warning("%s; it is not known whether the plugins of the run are still the same", why)
    return None


def with_present(known: Packages | None, present: Packages) -> Packages:
    """Return the known packages, extended by the versions of the present packages."""
    known = known or {}
    packages = {**known}
    for name, package in present.items():
        before = known[name].versions if name in known else ()
        new = package.versions if before[-1:] != package.versions else ()
        packages[name] = Package(versions=(*before, *new), components=package.components)
    return packages


def history(packages: Packages) -> tuple[str, ...]:
    """Return a note on each package of which several versions trained the run."""
    return tuple(
        (
            f"trained with {name} {', then '.join(package.versions)} "
            f"(--accept-plugins){': ' if package.components else ''}"
            f"{', '.join(package.components)}"
        )
        for name, package in packages.items()
        if len(package.versions) > 1
    )


def without_outdated(notes: Iterable[str], packages: Packages) -> Iterator[str]:
    """Remove notes that name a single version of a package if several versions trained the run."""
    outdated = tuple(
        f"from {name} {version}: "
        for name, package in packages.items()
        if len(package.versions) > 1
        for version in package.versions
    )
    return (note for note in notes if not note.startswith(outdated))


def refuse_missing(
    folder: Path, packages: Packages | None, optional: Container[str] = frozenset()
) -> None:
    """Refuse a run whose components are not installed, and name their packages.

    Args:
        folder: The run's folder.
        packages: The packages that trained the run; None if they are unknown.
        optional: Slots (singular words) whose components are not needed.

    Raises:
        UserError: Components are missing.
    """
    gone = {
        name: lost
        for name, package in (packages or {}).items()
        if (lost := [component for component in package.components if _lacks(component, optional)])
    }
    if gone and packages:
        named = {name: f"{name}=={packages[name].versions[-1]}" for name in gone}
        raise UserError(
            "the run was trained with components that are not installed here",
            where=folder / FILE,
            expected=listed(f"{listed(lost)} of {name}" for name, lost in gone.items()),
            found=listed(_found(name) for name in gone),
            todo=f"pip install {' '.join(named.values())}",
        )


def changes(packages: Packages | None) -> dict[str, str]:
    """Return old version -> new version of each package that changed since the last training."""
    changed = {}
    for name, package in (packages or {}).items():
        was = f"{name} {package.versions[-1]}"
        if name == OURS:
            now = {f"{OURS} {VERSION}"}
        else:
            present = (_entry(component) for component in package.components)
            now = {
                f"{entry.distribution} {entry.version}" for entry in present if entry is not None
            }
        if now - {was}:
            changed[was] = listed(sorted(now))
    return changed


def refuse_changed(folder: Path, packages: Packages | None) -> None:
    """Refuse to continue a run if the versions of its packages have changed.

    Raises:
        UserError: A package has another version, or a component comes from another package.
    """
    if changed := changes(packages):
        raise UserError(
            "the run was trained with other versions of packages",
            where=folder / FILE,
            expected=listed(changed),
            found=listed(changed.values()),
            todo="install the same versions again, or add --accept-plugins to resume with the "
            "installed versions",
        )


def report_changed(packages: Packages | None) -> None:
    """Log a warning for each package of which another version trained the run."""
    for was, now in changes(packages).items():
        _LOG.warning("the run was trained with %s; the installed version is %s", was, now)


def _parts(value: object) -> Iterator[Component]:
    """Yield the components in a value, including components in the options of other components."""
    if isinstance(value, Component):
        yield value
    inner: Iterable[object] = ()
    if isinstance(value, BaseModel):
        inner = vars(value).values()
    elif isinstance(value, Mapping):
        inner = value.values()
    elif isinstance(value, list | tuple):
        inner = value
    for item in inner:
        yield from _parts(item)


def _described(entry: Entry) -> str:
    return f"{singular(entry.slot)} {entry.name}"


def _entry(component: str) -> Entry | None:
    """Return the entry of a component such as `operator pcgrad`; None for a missing component."""
    word, _, name = component.partition(" ")
    return entries(plural(word)).get(name) if plural(word) in GROUPS else None


def _lacks(component: str, optional: Container[str]) -> bool:
    return component.partition(" ")[0] not in optional and _entry(component) is None


def _found(package: str) -> str:
    """Return the installed version of a package whose components are missing, as a message."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"{package} {version(package)}, which does not contain these components"
    except (PackageNotFoundError, ValueError):
        return f"package {package} is not installed"
