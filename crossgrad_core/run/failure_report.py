"""Why a run failed, in words, and whether a traceback is worth keeping."""

import traceback
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.training.failure import TrainingFailedError

#: How torch says that there is no memory, besides errors of a type of its own.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")


def reason_of(error: BaseException) -> str:
    """What went wrong; of an unexpected error also its type and place."""
    if not is_unexpected(error):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    if is_out_of_memory(error):
        return f"out of memory ({text}); try --max-gaussians N or --max-size PIXELS"
    return f"{text}{_place(error)}"


def is_unexpected(error: BaseException) -> bool:
    """Whether the error is none that crossgrad words for its users."""
    return not isinstance(error, UserError | TrainingFailedError)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory was asked for that is not there."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(sign in str(error) for sign in _NO_MEMORY)


def traceback_of(error: BaseException) -> str:
    """The traceback as text."""
    return "".join(traceback.format_exception(error))


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return ""
    last = frames[-1]
    return f" ({Path(last.filename).name}, line {last.lineno}, in {last.name})"
