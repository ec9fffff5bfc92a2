"""Small pieces of error messages. Imports nothing heavy."""

from collections.abc import Iterable


def singular(slot: str) -> str:
    """The word for one member of a slot: `operators` -> `operator`."""
    return slot.removesuffix("s")


def listed(names: Iterable[str]) -> str:
    """Names as `a, b, c`; `none` where there are none."""
    return ", ".join(names) or "none"


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """`did you mean 'x'?` where one of the choices is close to `name`, else an empty string."""
    from difflib import get_close_matches

    close = get_close_matches(name, list(choices), n=1)
    return f"did you mean {close[0]!r}?" if close else ""


def sentences(*parts: str) -> str:
    """The non-empty parts, joined by semicolons."""
    return "; ".join(part for part in parts if part)


def in_one_line(error: BaseException) -> str:
    """Type and text of an exception without line breaks."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
