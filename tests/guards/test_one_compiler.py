"""Every kernel is compiled through `numerics.jit`, and loads where nothing can be cached."""

import ast
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

PACKAGES = ("crossgrad_core", "crossgrad_backbones", "crossgrad_operators", "crossgrad_plugins")
#: What makes a function of Numba's; only one module may call it.
COMPILERS = {"njit", "jit", "vectorize", "guvectorize", "cfunc", "stencil", "jit_module"}
JIT = "crossgrad_core/numerics/jit.py"
SOURCES = {
    f"{package}/{path.relative_to(folder).as_posix()}": path
    for package in PACKAGES
    for folder in map(Path, find_spec(package).submodule_search_locations)
    for path in sorted(folder.rglob("*.py"))
}
KERNELS = [name for name in SOURCES if "/numba_kernels/" in name]


def compilers_in(source):
    """Names of Numba's compilers that a module imports or reaches through the package."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "numba":
            yield from COMPILERS & {alias.name for alias in node.names}
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in {"numba", "nb"}:
            yield from COMPILERS & {node.attr}


def test_only_one_module_calls_the_compiler():
    calling = {name for name, path in SOURCES.items() if list(compilers_in(path.read_bytes()))}
    assert calling == {JIT}


@pytest.mark.parametrize(
    "source",
    [
        "from numba import njit",
        "from numba.core.decorators import jit",
        "import numba\nnumba.njit()",
    ],
)
def test_the_guard_finds_each_way_to_call_the_compiler(source):
    assert list(compilers_in(source))


@pytest.mark.slow
def test_all_kernels_load_if_no_folder_can_hold_a_cache():
    modules = [name.removesuffix(".py").replace("/", ".") for name in KERNELS]
    modules = [name.removesuffix(".__init__") for name in modules]
    program = "import sys, importlib\nfor name in sys.argv[1:]: importlib.import_module(name)"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        # No other place is tried, and this one cannot be made.
        "NUMBA_CACHE_LOCATOR_CLASSES": "UserWideCacheLocator",
        "NUMBA_CACHE_DIR": "",
        "HOME": os.devnull,
        "XDG_CACHE_HOME": f"{os.devnull}/cache",
    }
    command = [sys.executable, "-c", program, *modules]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert len(KERNELS) > 30 and "NUMBA_CACHE_DIR=FOLDER" in done.stderr
