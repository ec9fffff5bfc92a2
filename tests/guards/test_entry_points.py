"""Each entry point loads, and each component that ships has an entry point."""

import inspect
import pkgutil
from importlib import import_module
from importlib.util import find_spec

import pytest

from crossgrad_core.contract.component import Component
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.commands import load_command
from crossgrad_core.registry.slots import COMMANDS, GROUPS
from crossgrad_core.testing.checking import checks_of

PLUGIN_PACKAGES = ("crossgrad_backbones", "crossgrad_operators", "crossgrad_plugins")
OURS = [
    entry for slot in GROUPS for entry in registry.offers(slot) if entry.distribution == "crossgrad"
]
COMMANDS_OF_OURS = [each for each in registry.offers(COMMANDS) if each.distribution == "crossgrad"]


@pytest.mark.parametrize("entry", OURS, ids=lambda entry: f"{entry.slot}-{entry.name}")
def test_each_entry_point_loads(entry):
    component = registry.load(entry.slot, entry.name)
    assert component.__doc__
    assert component.__module__.partition(".")[0] in PLUGIN_PACKAGES


@pytest.mark.parametrize("entry", OURS, ids=lambda entry: f"{entry.slot}-{entry.name}")
def test_each_plugin_name_is_easy_to_type(entry):
    # Recipes of one paper share the first part of their names.
    assert all(part.replace("-", "").isalnum() for part in entry.name.split("/"))
    assert entry.name == entry.name.lower()


@pytest.mark.parametrize("entry", COMMANDS_OF_OURS, ids=lambda entry: entry.name)
def test_each_command_loads_from_a_plugin_package(entry):
    assert entry.package in PLUGIN_PACKAGES
    assert load_command(entry)
    for check in checks_of(COMMANDS):
        check(load_command(entry))


@pytest.mark.parametrize("folder", PLUGIN_PACKAGES)
def test_each_component_has_an_entry_point(folder):
    offered = {entry.value for entry in OURS}
    for module in modules_of(folder):
        for name, kind in inspect.getmembers(import_module(module), is_component):
            if kind.__module__ == module:
                assert f"{module}:{name}" in offered


def modules_of(package):
    spec = find_spec(package)
    places = spec.submodule_search_locations
    found = [info for info in pkgutil.walk_packages(places, f"{package}.") if not info.ispkg]
    return [info.name for info in found]


def is_component(found):
    """A concrete component; bases that components share are abstract or private."""
    return (
        inspect.isclass(found)
        and issubclass(found, Component)
        and not inspect.isabstract(found)
        and not found.__name__.startswith("_")
    )
