"""Whether the methods of a component take what crossgrad calls them with."""

from functools import cache
from inspect import Parameter, Signature, getattr_static, isfunction, signature
from typing import Final

_POSITIONAL: Final = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
#: Where the methods are defined that crossgrad calls.
_CONTRACT: Final = "crossgrad_core.contract."


@cache
def wrong_signatures(found: type, base: type) -> tuple[tuple[str, str, str], ...]:
    """Methods that cannot be called like those of the base class that they replace.

    Hooks are left out: they may take fewer arguments.

    Args:
        found: A subclass of `base`.
        base: The base class of a slot.

    Returns:
        The name, the signature of the base class and the one that was found, of each.
    """
    contract = [each for each in base.__mro__ if each.__module__.startswith(_CONTRACT)]
    names = dict.fromkeys(name for each in contract for name in vars(each))
    wrong = []
    for name in names:
        theirs, own = getattr_static(base, name), getattr_static(found, name)
        if name.startswith(("_", "crossgrad_")) or own is theirs:
            continue
        if isfunction(theirs) and isfunction(own):
            # A decorator may pass arguments of its own: what it takes itself counts.
            expected, given = signature(theirs), signature(own, follow_wrapped=False)
            if not _takes(given, expected, whole=True) or not _takes(given, expected, whole=False):
                wrong.append((name, str(expected), str(given)))
    return tuple(wrong)


def _takes(given: Signature, expected: Signature, *, whole: bool) -> bool:
    """Whether a call with all arguments, or with those that have no default, can be made."""
    passed = [p for p in expected.parameters.values() if whole or p.default is Parameter.empty]
    positional = [each for each in passed if each.kind in _POSITIONAL]
    named = {each.name: None for each in passed if each.kind is Parameter.KEYWORD_ONLY}
    try:
        given.bind(*(None for _ in positional), **named)
    except TypeError:
        return False
    return True
