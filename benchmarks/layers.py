"""Draw docs/layers.svg: the packages of the code by layer, and their imports.

    python benchmarks/layers.py [--png FILE]

The imports are read from the sources. An arrow is omitted if a longer path connects its two ends.
"""

import argparse
import ast
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
CORE = "crossgrad_core"
PLUGIN_PACKAGES = {
    "backbones": "crossgrad_backbones",
    "operators": "crossgrad_operators",
    "plugins": "crossgrad_plugins",
}
WIDTH, HEIGHT = 11.0, 9.0


def package_of(module: str) -> str | None:
    """Return the package of one of crossgrad's modules; None for other modules."""
    package, _, rest = f"{module}.__init__".partition(".")
    if package == CORE:
        return rest.split(".")[0]
    return next((folder for folder, name in PLUGIN_PACKAGES.items() if name == package), None)


def files() -> dict[Path, str]:
    """Return the package of each source file."""
    found = {}
    for path in sorted((ROOT / CORE).rglob("*.py")):
        found[path] = path.relative_to(ROOT / CORE).with_suffix("").parts[0]
    for folder, package in PLUGIN_PACKAGES.items():
        found |= dict.fromkeys((ROOT / folder / package).rglob("*.py"), folder)
    return found


def packages() -> dict[str, set[str]]:
    """Return the packages that each package imports."""
    found = files()
    graph: dict[str, set[str]] = {package: set() for package in found.values()}
    for path, package in found.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                inside = [f"{node.module}.{each.name}" for each in node.names]
                names = inside if node.module == CORE else [node.module]
            graph[package] |= {other for name in names if (other := package_of(name)) in graph}
    return {package: others - {package, "__init__"} for package, others in graph.items()}


def direct(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Return the graph without arrows that are implied by longer paths."""
    reached: dict[str, set[str]] = {}

    def all_from(package: str) -> set[str]:
        if package not in reached:
            reached[package] = set().union(*({other} | all_from(other) for other in graph[package]))
        return reached[package]

    return {
        package: {each for each in others if not any(each in all_from(o) for o in others - {each})}
        for package, others in graph.items()
    }


def layers(graph: Mapping[str, set[str]]) -> dict[str, int]:
    """Return the layer of each package: one above the highest layer that it imports from."""
    found: dict[str, int] = {}

    def layer(package: str) -> int:
        if package not in found:
            found[package] = 1 + max((layer(other) for other in graph[package]), default=-1)
        return found[package]

    for package in graph:
        layer(package)
    return found


def draw(path: Path) -> None:
    """Write the picture. The suffix of `path` gives the format."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "layers"})
    import matplotlib.pyplot as plt

    graph = packages()
    layer = layers(graph)
    places = {}
    for level in range(max(layer.values()) + 1):
        here = sorted(package for package in graph if layer[package] == level)
        for number, package in enumerate(here):
            # Shift every second row of boxes, so that arrows can pass between the boxes.
            shift = 0.25 * (level % 2 * 2 - 1)
            places[package] = (WIDTH * (number + 1) / (len(here) + 1) + shift, float(level))
    figure, axes = plt.subplots(figsize=(WIDTH, HEIGHT))
    for package, others in direct(graph).items():
        for other in sorted(others):
            far = places[package][1] - places[other][1] > 1
            axes.annotate(
                "", xy=places[other], xytext=places[package],
                arrowprops={"arrowstyle": "-|>", "color": "#8a94a6", "shrinkA": 12, "shrinkB": 12,
                            "connectionstyle": f"arc3,rad={0.12 if far else 0}"},
            )  # fmt: skip
    for package, (x, y) in places.items():
        color = "#fbe6c8" if package in PLUGIN_PACKAGES else "#dbe7f6"
        box = {"boxstyle": "round,pad=0.4", "facecolor": color, "edgecolor": "#5b6676"}
        axes.text(
            x, y, package, ha="center", va="center", family="monospace", fontsize=11, bbox=box
        )
    axes.set(xlim=(0, WIDTH), ylim=(-0.6, max(layer.values()) + 0.6))
    axes.axis("off")
    undated = {"Date": None} if path.suffix == ".svg" else None
    figure.savefig(path, bbox_inches="tight", metadata=undated)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--png", type=Path, help="additional PNG file for viewing")
    draw(parser.parse_args().png or ROOT / "docs" / "layers.svg")
