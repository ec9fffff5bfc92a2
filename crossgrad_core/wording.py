"""Functions that make parts of error messages. This module imports no large package."""

import re
from collections.abc import Iterable

# Control characters could move the cursor or change the colours of the terminal. Characters for
# bidirectional text could reorder a line. Single surrogates represent bytes that are not UTF-8 and
# cannot be written to a file.
_UNSHOWABLE = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def showable(text: str) -> str:
    """Return text in a form that a terminal can show; line feeds are kept."""
    return _UNSHOWABLE.sub(lambda match: ascii(match.group())[1:-1], text)


def one_line(text: object) -> str:
    """Return text as one line with escaped line feeds, for names and paths."""
    return showable(str(text)).replace("\n", "\\n")


def singular(slot: str) -> str:
    """Return the word for one member of a slot: `operators` -> `operator`, `losses` -> `loss`."""
    return slot.removesuffix("es" if slot.endswith("sses") else "s")


def with_article(noun: str) -> str:
    """Return `a sampler` or `an operator`, chosen by the first letter, not by the sound."""
    return f"an {noun}" if noun[0] in "aeio" else f"a {noun}"


def plural(word: str) -> str:
    """Return the name of the slot for a singular word: `operator` -> `operators`."""
    return f"{word}es" if word.endswith("ss") else f"{word}s"


def count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 photo`, `2 photos`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def listed(names: Iterable[str]) -> str:
    """Return names as `a, b, c`; `none` without names."""
    return ", ".join(names) or "none"


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return `did you mean 'x'?` if one of the choices is close to `name`, else an empty string."""
    from difflib import get_close_matches

    close = get_close_matches(name, list(choices), n=1)
    return f"did you mean {close[0]!r}?" if close else ""


def sentences(*parts: str) -> str:
    """Return the parts that are not empty, joined by semicolons."""
    return "; ".join(part for part in parts if part)


def in_one_line(error: BaseException) -> str:
    """Return type and text of an exception without line breaks."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
