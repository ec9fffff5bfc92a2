"""Contract checks for commands, which entry points in `crossgrad.commands` register.

Checks of commands receive the command itself, `check(my_command)`, and not a function that creates
the command.
"""

import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from typing import Final

import typer

from crossgrad_core.registry.commands import Command, as_group_member
from crossgrad_core.testing.support.contract import cannot_tell, require
from crossgrad_core.wording import listed

#: Libraries that take long to import. A command must print its first message before the import of
#: one of these libraries.
HEAVY: Final = ("matplotlib", "numba", "numpy", "pydantic", "scipy", "torch")
_IMPORTED = """
import sys
sys.path[:] = {path!r}
import {module}
print(*[name for name in {heavy!r} if name in sys.modules])
"""


def help_has_a_first_line(command: Command) -> None:
    """`crossgrad --help` can show a description of the command."""
    text = as_group_member(command, "command").get_short_help_str()
    require(text, "the command has no help: write a docstring, or `typer.Typer(help=...)`")


def help_can_be_shown(command: Command) -> None:
    """`crossgrad COMMAND --help` prints a text and ends without an error."""
    printed = StringIO()
    with redirect_stdout(printed):
        as_group_member(command, "command").main(["--help"], "command", standalone_mode=False)
    require("Usage" in printed.getvalue(), "--help prints no usage line")


def importing_it_is_quick(command: Command) -> None:
    """The module of the command imports none of the libraries that take long to import.

    A user must see within two seconds that the command has started. Slow imports must therefore be
    inside the function of the command.
    """
    module = _module(command)
    program = _IMPORTED.format(path=sys.path, module=module, heavy=HEAVY)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    require(done.returncode == 0, f"importing {module} alone fails: {done.stderr.strip()[-300:]}")
    imported = done.stdout.split()
    require(
        not imported,
        f"importing {module} imports {listed(imported)}: import them inside the function",
    )


def _module(command: Command) -> str:
    """Return the name of the module that defines the command."""
    if not isinstance(command, typer.Typer):
        return command.__module__
    registered = [member.callback for member in (*command.registered_commands,)]
    if command.registered_callback is not None:
        registered.append(command.registered_callback.callback)
    modules = [callback.__module__ for callback in registered if callback is not None]
    if not modules:
        raise cannot_tell("the typer app has no command of its own")
    return modules[0]


COMMAND_CHECKS: tuple[Callable[[Command], None], ...] = (
    help_has_a_first_line,
    help_can_be_shown,
    importing_it_is_quick,
)
