"""Where in a plugin's source something is wrong: `file:line`, as editors and terminals open it."""

import inspect
import traceback
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path


def raised_at(error: BaseException, package: str) -> str:
    """The innermost line of a package that an exception passed; empty where it passed none.

    Args:
        error: The exception, or one that was raised from it.
        package: Name of the import package or module.
    """
    roots = _roots(package)
    found = ""
    for each in _chain(error):
        if isinstance(each, SyntaxError) and _below(each.filename, roots):
            return f"{each.filename}:{each.lineno or 1}"
        for frame in traceback.extract_tb(each.__traceback__):
            if _below(frame.filename, roots):
                found = f"{frame.filename}:{frame.lineno or 1}"
    return found


def defined_at(thing: object) -> str:
    """Where a class or function is defined; empty where it has no source."""
    try:
        return f"{inspect.getsourcefile(thing)}:{inspect.getsourcelines(thing)[1]}"  # type: ignore[arg-type]
    except (TypeError, OSError):
        return ""


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The exception and those that it was raised from."""
    each: BaseException | None = error
    while each is not None:
        yield each
        each = each.__cause__


def _roots(package: str) -> tuple[Path, ...]:
    """The folders of a package, or the file of a module; nothing is imported."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        return ()
    if spec is None:
        return ()
    if spec.submodule_search_locations is not None:
        return tuple(Path(folder) for folder in spec.submodule_search_locations)
    return (Path(spec.origin),) if spec.origin else ()


def _below(file: str | None, roots: tuple[Path, ...]) -> bool:
    path = Path(file or "")
    return any(path == root or root in path.parents for root in roots)
