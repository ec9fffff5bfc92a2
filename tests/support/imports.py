"""Which module imports which, read from the sources; imports inside functions count, too."""

import ast
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]
CORE = "crossgrad_core"
PLUGIN_PACKAGES = {
    "crossgrad_backbones": ROOT / "backbones" / "crossgrad_backbones",
    "crossgrad_operators": ROOT / "operators" / "crossgrad_operators",
    "crossgrad_plugins": ROOT / "plugins" / "crossgrad_plugins",
}


def modules() -> dict[str, Path]:
    """Dotted name -> file of every module that ships."""
    found = {}
    for name, folder in {CORE: ROOT / CORE, **PLUGIN_PACKAGES}.items():
        for file in sorted(folder.rglob("*.py")):
            parts = [name, *file.relative_to(folder).with_suffix("").parts]
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports(file: Path, known: Mapping[str, Path]) -> set[str]:
    """The modules among `known` that a file imports: at its top, in functions, for types only."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {each.name for each in node.names if each.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for each in node.names:
                whole = f"{node.module}.{each.name}"
                found |= {whole} if whole in known else {node.module} & known.keys()
    return found


def import_graph() -> dict[str, set[str]]:
    """Module -> the modules of ours that it imports."""
    known = modules()
    return {name: imports(file, known) - {name} for name, file in known.items()}


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """A way through the graph that ends where it began; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []
