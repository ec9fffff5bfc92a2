"""Help and lists must be instant: they import no plugin and none of the heavy libraries."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "numba", "numpy", "scipy", "PIL", "pycolmap", "matplotlib", "yaml", "rich")
OURS = ("crossgrad_backbones", "crossgrad_operators", "crossgrad_plugins")
#: Where `crossgrad plugins` itself is.
COMMAND = ("crossgrad_plugins", "crossgrad_plugins.authoring", "crossgrad_plugins.authoring.cli")
PROGRAM = """
import sys
from crossgrad_core.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as ended:
    assert not ended.code, ended.code
print("\\n".join(sorted(sys.modules)), file=sys.stderr)
"""


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("--version",), ("run", "--help"), ("plugins", "list"), ("plugins",)],
    ids=" ".join,
)
def test_help_and_lists_import_no_plugin_and_no_heavy_library(arguments):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True
    )
    modules = ended.stderr.splitlines()
    own = COMMAND if arguments[0] == "plugins" else ()
    imported = {module.partition(".")[0] for module in modules if module not in own}
    assert "typer" in imported
    assert imported.isdisjoint({*HEAVY, *OURS})
