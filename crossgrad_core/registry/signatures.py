"""Checks of the signatures of component methods, and source locations for messages."""

import inspect
import traceback
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from inspect import Parameter, Signature, getattr_static, isfunction, signature
from pathlib import Path
from typing import Final

_POSITIONAL: Final = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
#: Prefix of the modules whose base classes define the methods that crossgrad calls.
_CONTRACT: Final = "crossgrad_core.contract."


@cache
def wrong_signatures(found: type, base: type) -> tuple[tuple[str, str, str], ...]:
    """Return the methods that cannot be called like the base class's methods.

    Hooks are not checked, because they may take fewer arguments.

    Args:
        found: A subclass of `base`.
        base: The base class of a slot.

    Returns: Name, signature in the base class and actual signature, for each wrong method.
    """
    contract = [ancestor for ancestor in base.__mro__ if ancestor.__module__.startswith(_CONTRACT)]
    names = dict.fromkeys(name for ancestor in contract for name in vars(ancestor))
    wrong = []
    for name in names:
        theirs, ours = getattr_static(base, name), getattr_static(found, name)
        if name.startswith(("_", "crossgrad_")) or ours is theirs:
            continue
        if isfunction(theirs) and isfunction(ours):
            # Use the signature of the function that a decorator returned, because crossgrad calls
            # this function.
            expected, given = signature(theirs), signature(ours, follow_wrapped=False)
            if not _takes(given, expected, whole=True) or not _takes(given, expected, whole=False):
                wrong.append((name, str(expected), str(given)))
    return tuple(wrong)


def _takes(given: Signature, expected: Signature, *, whole: bool) -> bool:
    """Return True if a call with all (`whole`) or only the required arguments is possible."""
    passed = [p for p in expected.parameters.values() if whole or p.default is Parameter.empty]
    positional = [parameter for parameter in passed if parameter.kind in _POSITIONAL]
    named = {
        parameter.name: None for parameter in passed if parameter.kind is Parameter.KEYWORD_ONLY
    }
    try:
        given.bind(*(None for _ in positional), **named)
    except TypeError:
        return False
    return True


def raised_at(error: BaseException, package: str) -> str:
    """Return the innermost source line of a package in the traceback of an exception; else empty.

    Args:
        error: The exception; the exceptions that caused it are searched as well.
        package: Name of the import package or module.
    """
    roots = _roots(package)
    innermost = ""
    for exception in _chain(error):
        if isinstance(exception, SyntaxError) and _below(exception.filename, roots):
            return f"{exception.filename}:{exception.lineno or 1}"
        for frame in traceback.extract_tb(exception.__traceback__):
            if _below(frame.filename, roots):
                innermost = f"{frame.filename}:{frame.lineno or 1}"
    return innermost


def defined_at(thing: object) -> str:
    """Return file and line of the definition of a class or function; empty without a source."""
    try:
        return f"{inspect.getsourcefile(thing)}:{inspect.getsourcelines(thing)[1]}"  # type: ignore[arg-type]
    except (TypeError, OSError):
        return ""


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield the exception and the exceptions that caused it."""
    exception: BaseException | None = error
    while exception is not None:
        yield exception
        exception = exception.__cause__


def _roots(package: str) -> tuple[Path, ...]:
    """Return the folders of a package, or the file of a module; nothing is imported."""
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
