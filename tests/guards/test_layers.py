"""Layers of the core and public modules for plugin packages: who may import whom."""

import re
import subprocess
import sys

import pytest
from support.imports import CORE, PLUGIN_PACKAGES, ROOT, circle, import_graph, imports, modules

#: The packages and files of the core from the lowest layer to the highest. A layer imports lower
#: ones only.
LAYERS = (
    ("wording", "defaults"),
    ("errors",),
    ("system",),
    ("numerics",),
    ("contract",),
    ("gradients", "scene", "config"),
    ("registry",),
    ("training", "recipe"),
    ("evaluation",),
    ("run",),
    ("plugin", "testing", "commands"),
    ("cli",),
    ("__init__", "__main__"),
)
LAYER = {package: number for number, packages in enumerate(LAYERS) for package in packages}
#: What a plugin package may import of the core: components and kernels, readers, commands.
PUBLIC = (f"{CORE}.plugin", f"{CORE}.numerics")
READERS = (*PUBLIC, f"{CORE}.scene")
COMMANDS_IMPORT = (*PUBLIC, f"{CORE}.commands")
PLACES = {
    "crossgrad_plugins.readers": READERS,
    # Reads the headers of photo files.
    "crossgrad_plugins.exposures.exif": READERS,
    # Finds features with pycolmap, which is imported with care.
    "crossgrad_plugins.initializers.triangulated": READERS,
    # Checks packages, and writes one for each slot, readers and tests included.
    "crossgrad_plugins.authoring": (*COMMANDS_IMPORT, *READERS, f"{CORE}.testing"),
    "crossgrad_plugins.compare": COMMANDS_IMPORT,
    "crossgrad_plugins.diagnostics": COMMANDS_IMPORT,
    "crossgrad_plugins.planner": COMMANDS_IMPORT,
    # Reads photos and their headers, which is what comes before a scene.
    "crossgrad_plugins.prepare": (*COMMANDS_IMPORT, *READERS),
    # `crossgrad recipes`.
    "crossgrad_plugins.recipes.cli": COMMANDS_IMPORT,
    "crossgrad_plugins.scene_check": COMMANDS_IMPORT,
    "crossgrad_plugins.sweep": COMMANDS_IMPORT,
    "crossgrad_plugins.view": COMMANDS_IMPORT,
    "crossgrad_operators.stress": COMMANDS_IMPORT,
}
#: Files at the top of the core.
MOST_FILES = 9


@pytest.fixture(scope="module")
def graph():
    return import_graph()


def package(module):
    return [*module.split("."), "__init__"][1]


def test_the_imports_contain_no_cycle(graph):
    assert not circle(graph)


def test_the_guard_finds_an_import_cycle(tmp_path):
    (tmp_path / "a.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p.b import B\n"
    )
    (tmp_path / "b.py").write_text("def late():\n    from p import a\n")
    known = {"p.a": tmp_path / "a.py", "p.b": tmp_path / "b.py"}
    graph = {name: imports(file, known) for name, file in known.items()}
    assert set(circle(graph)) == {"p.a", "p.b"}


def test_every_package_of_the_core_has_a_layer():
    inside = {package(name) for name in modules() if name.split(".")[0] == CORE}
    assert inside == set(LAYER)


@pytest.mark.parametrize("here", LAYER)
def test_modules_import_lower_layers_only(here, graph):
    upward = [
        f"{module} -> {other}"
        for module, others in graph.items()
        if module.split(".")[0] == CORE and package(module) == here
        for other in others
        # The core's own __init__ holds its version.
        if other.split(".")[0] == CORE and package(other) not in {here, "__init__"}
        if LAYER[package(other)] >= LAYER[here]
    ]
    assert not upward


def test_the_core_imports_no_plugin_package(graph):
    assert not [
        f"{module} -> {other}"
        for module, others in graph.items()
        if module.split(".")[0] == CORE
        for other in others
        if other.split(".")[0] in PLUGIN_PACKAGES
    ]


@pytest.mark.parametrize("folder", PLUGIN_PACKAGES)
def test_plugin_packages_import_public_modules_only(folder, graph):
    beside = []
    for module, others in graph.items():
        if module.split(".")[0] != folder:
            continue
        public = next((public for place, public in PLACES.items() if _in(module, place)), PUBLIC)
        beside += [
            f"{module} -> {other}"
            for other in others
            if other.split(".")[0] == CORE and not any(_in(other, module) for module in public)
        ]
    assert not beside


def _in(module, place):
    return module == place or module.startswith(f"{place}.")


def test_the_core_has_few_top_level_files():
    files = sorted(path.name for path in (ROOT / CORE).glob("*.py"))
    assert len(files) <= MOST_FILES, files


def test_the_architecture_page_shows_the_layers_of_the_guard():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.+?) \|", page, re.MULTILINE)
    shown = {int(number): tuple(re.findall(r"`([\w_]+)", cell)) for number, cell in rows}
    assert shown == dict(enumerate(LAYERS, 1))


def test_the_public_module_for_components_is_imported_quickly():
    program = "import sys, crossgrad_core.plugin; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    heavy = {"numba", "scipy", "PIL", "matplotlib", "skimage", "pycolmap", "yaml", "typer"}
    assert not heavy & set(done.stdout.split())
