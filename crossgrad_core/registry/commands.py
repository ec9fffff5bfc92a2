"""Commands of plugins: the help describes them without an import, and a call imports them."""

import ast
import inspect
from collections.abc import Callable
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import typer
from typer.main import get_command

from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import Entry, resolve_entry
from crossgrad_core.system.command_options import GroupedCommand

if TYPE_CHECKING:
    from typer import _click as click

#: Type of the object at an entry point of the group `crossgrad.commands`.
Command: TypeAlias = "typer.Typer | Callable[..., Any]"


def load_command(entry: Entry) -> Command:
    """Return the typer app or function that an entry point names; its module is imported first.

    Raises:
        UserError: The object cannot be imported, or the object is neither a typer app nor a
            function.
    """
    command = resolve_entry(entry)
    if isinstance(command, typer.Typer) or inspect.isfunction(command):
        return command
    raise UserError(
        f"command {entry.name} cannot be used",
        where=entry.origin,
        expected="a typer.Typer, or a function with typer's annotations",
        found=repr(command),
        todo=f"repair or uninstall {entry.distribution}",
    )


def as_group_member(command: Command, name: str) -> "click.Command":
    """Return the command of a plugin as a click command.

    Args:
        command: A typer app, or a function; the help groups the options of a function.
        name: The name that users type.
    """
    if not isinstance(command, typer.Typer):
        app = typer.Typer(rich_markup_mode=None, add_completion=False)
        app.command(name, cls=GroupedCommand)(command)
        return get_command(app)
    return get_command(command)


def summary(entry: Entry) -> str:
    """Return the first line of a command's docstring, or of its module's docstring.

    The source file is read but not executed. Without a source file or a docstring, return a line
    that names the package.
    """
    module, _, name = entry.value.partition(":")
    try:
        tree = ast.parse(_source(module.strip()))
    except (OSError, ValueError, SyntaxError):
        return f"from {entry.distribution} {entry.version}"
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    docstrings = [ast.get_docstring(node) for node in functions if node.name == name.strip()]
    text = (docstrings and docstrings[0]) or ast.get_docstring(tree)
    return text.splitlines()[0] if text else f"from {entry.distribution} {entry.version}"


def _source(module: str) -> bytes:
    """Return the source of a module; unlike `importlib.util.find_spec`, import no parent package.

    Raises:
        FileNotFoundError: The module does not exist.
    """
    parts = module.split(".")
    path: list[str] | None = None
    spec = None
    for count in range(1, len(parts) + 1):
        spec = PathFinder.find_spec(".".join(parts[:count]), path)
        if spec is None:
            raise FileNotFoundError(module)
        path = list(spec.submodule_search_locations or ())
    return Path((spec and spec.origin) or module).read_bytes()
