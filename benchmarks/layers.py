"""Draws docs/layers.svg: the rooms of the code by floors, and who imports whom.

    python benchmarks/layers.py [--png FILE]

Read from the sources. An arrow is left out where a longer way through other rooms leads to the same
place.
"""

import argparse
import ast
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
CORE = "crossgrad_core"
SHELVES = {"backbones": "crossgrad_backbones", "operators": "crossgrad_operators",
           "plugins": "crossgrad_plugins"}  # fmt: skip
WIDTH, HEIGHT = 11.0, 9.0


def room_of(module: str) -> str | None:
    """The room that a module of ours stands in; None for others."""
    package, _, rest = f"{module}.__init__".partition(".")
    if package == CORE:
        return rest.split(".")[0]
    return next((shelf for shelf, name in SHELVES.items() if name == package), None)


def files() -> dict[Path, str]:
    """File -> its room."""
    found = {}
    for path in sorted((ROOT / CORE).rglob("*.py")):
        found[path] = path.relative_to(ROOT / CORE).with_suffix("").parts[0]
    for shelf, package in SHELVES.items():
        found |= dict.fromkeys((ROOT / shelf / package).rglob("*.py"), shelf)
    return found


def rooms() -> dict[str, set[str]]:
    """Room -> the rooms that it imports."""
    found = files()
    graph: dict[str, set[str]] = {room: set() for room in found.values()}
    for path, room in found.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                inside = [f"{node.module}.{each.name}" for each in node.names]
                names = inside if node.module == CORE else [node.module]
            graph[room] |= {other for name in names if (other := room_of(name)) in graph}
    return {room: others - {room, "__init__"} for room, others in graph.items()}


def direct(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """The graph without arrows that a longer way makes superfluous."""
    reached: dict[str, set[str]] = {}

    def all_from(room: str) -> set[str]:
        if room not in reached:
            reached[room] = set().union(*({other} | all_from(other) for other in graph[room]))
        return reached[room]

    return {
        room: {each for each in others if not any(each in all_from(o) for o in others - {each})}
        for room, others in graph.items()
    }


def floors(graph: Mapping[str, set[str]]) -> dict[str, int]:
    """Room -> its floor: one above the highest that it imports."""
    found: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in found:
            found[room] = 1 + max((floor(other) for other in graph[room]), default=-1)
        return found[room]

    for room in graph:
        floor(room)
    return found


def draw(path: Path) -> None:
    """Writes the picture; `path` says by its suffix in which format."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "rooms"})
    import matplotlib.pyplot as plt

    graph = rooms()
    floor = floors(graph)
    places = {}
    for level in range(max(floor.values()) + 1):
        here = sorted(room for room in graph if floor[room] == level)
        for number, room in enumerate(here):
            # Rows are shifted against each other, so that arrows pass between the boxes.
            shift = 0.25 * (level % 2 * 2 - 1)
            places[room] = (WIDTH * (number + 1) / (len(here) + 1) + shift, float(level))
    figure, axes = plt.subplots(figsize=(WIDTH, HEIGHT))
    for room, others in direct(graph).items():
        for other in sorted(others):
            far = places[room][1] - places[other][1] > 1
            axes.annotate(
                "", xy=places[other], xytext=places[room],
                arrowprops={"arrowstyle": "-|>", "color": "#8a94a6", "shrinkA": 12, "shrinkB": 12,
                            "connectionstyle": f"arc3,rad={0.12 if far else 0}"},
            )  # fmt: skip
    for room, (x, y) in places.items():
        color = "#fbe6c8" if room in SHELVES else "#dbe7f6"
        box = {"boxstyle": "round,pad=0.4", "facecolor": color, "edgecolor": "#5b6676"}
        axes.text(x, y, room, ha="center", va="center", family="monospace", fontsize=11, bbox=box)
    axes.set(xlim=(0, WIDTH), ylim=(-0.6, max(floor.values()) + 0.6))
    axes.axis("off")
    undated = {"Date": None} if path.suffix == ".svg" else None
    figure.savefig(path, bbox_inches="tight", metadata=undated)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--png", type=Path, help="another file, to look at")
    draw(parser.parse_args().png or ROOT / "docs" / "layers.svg")
