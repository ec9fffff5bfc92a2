"""The rooms of the core and the doors of the shelves: who may import whom."""

import re
import subprocess
import sys

import pytest
from support.imports import CORE, ROOT, SHELVES, circle, import_graph, imports, modules

#: The rooms and files of the core from the lowest floor to the highest; imports go down. Those of
#: one floor do not import each other.
FLOORS = (
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
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
#: What every shelf may import of the core: components and kernels, readers, command rooms.
DOORS = (f"{CORE}.plugin", f"{CORE}.numerics")
READERS = (*DOORS, f"{CORE}.scene")
COMMAND_ROOMS = (*DOORS, f"{CORE}.commands")
PLACES = {
    "crossgrad_plugins.readers": READERS,
    # Reads the headers of photo files.
    "crossgrad_plugins.exposures.exif": READERS,
    # Finds features with pycolmap, which is imported with care.
    "crossgrad_plugins.initializers.triangulated": READERS,
    # Checks packages, and writes one for each slot, readers and tests included.
    "crossgrad_plugins.authoring": (*COMMAND_ROOMS, *READERS, f"{CORE}.testing"),
    "crossgrad_plugins.compare": COMMAND_ROOMS,
    "crossgrad_plugins.diagnostics": COMMAND_ROOMS,
    "crossgrad_plugins.planner": COMMAND_ROOMS,
    # Reads photos and their headers, which is what comes before a scene.
    "crossgrad_plugins.prepare": (*COMMAND_ROOMS, *READERS),
    # `crossgrad recipes`.
    "crossgrad_plugins.recipes.cli": COMMAND_ROOMS,
    "crossgrad_plugins.scene_check": COMMAND_ROOMS,
    "crossgrad_plugins.sweep": COMMAND_ROOMS,
    "crossgrad_operators.stress": COMMAND_ROOMS,
}
#: Files at the top of the core.
MOST_FILES = 9


@pytest.fixture(scope="module")
def graph():
    return import_graph()


def room(module):
    return [*module.split("."), "__init__"][1]


def test_there_is_no_circle(graph):
    assert not circle(graph)


def test_a_circle_would_be_found(tmp_path):
    (tmp_path / "a.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p.b import B\n"
    )
    (tmp_path / "b.py").write_text("def late():\n    from p import a\n")
    known = {"p.a": tmp_path / "a.py", "p.b": tmp_path / "b.py"}
    graph = {name: imports(file, known) for name, file in known.items()}
    assert set(circle(graph)) == {"p.a", "p.b"}


def test_every_room_has_a_floor():
    inside = {room(name) for name in modules() if name.split(".")[0] == CORE}
    assert inside == set(FLOOR)


@pytest.mark.parametrize("here", FLOOR)
def test_imports_go_down(here, graph):
    upward = [
        f"{module} -> {other}"
        for module, others in graph.items()
        if module.split(".")[0] == CORE and room(module) == here
        for other in others
        # What the core's own __init__ holds, its version, is no room.
        if other.split(".")[0] == CORE and room(other) not in {here, "__init__"}
        if FLOOR[room(other)] >= FLOOR[here]
    ]
    assert not upward


def test_the_core_imports_no_shelf(graph):
    assert not [
        f"{module} -> {other}"
        for module, others in graph.items()
        if module.split(".")[0] == CORE
        for other in others
        if other.split(".")[0] in SHELVES
    ]


@pytest.mark.parametrize("shelf", SHELVES)
def test_shelves_come_through_the_doors(shelf, graph):
    beside = []
    for module, others in graph.items():
        if module.split(".")[0] != shelf:
            continue
        doors = next((doors for place, doors in PLACES.items() if _in(module, place)), DOORS)
        beside += [
            f"{module} -> {other}"
            for other in others
            if other.split(".")[0] == CORE and not any(_in(other, door) for door in doors)
        ]
    assert not beside


def _in(module, place):
    return module == place or module.startswith(f"{place}.")


def test_the_hallway_is_short():
    files = sorted(path.name for path in (ROOT / CORE).glob("*.py"))
    assert len(files) <= MOST_FILES, files


def test_the_page_on_the_architecture_shows_these_floors():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.+?) \|", page, re.MULTILINE)
    shown = {int(number): tuple(re.findall(r"`([\w_]+)", cell)) for number, cell in rows}
    assert shown == dict(enumerate(FLOORS, 1))


def test_the_door_of_components_opens_quickly():
    program = "import sys, crossgrad_core.plugin; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    heavy = {"numba", "scipy", "PIL", "matplotlib", "skimage", "pycolmap", "yaml", "typer"}
    assert not heavy & set(done.stdout.split())
