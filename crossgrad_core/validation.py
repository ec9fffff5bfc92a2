"""Pydantic's validation errors in the words of a user error."""

from collections.abc import Iterable

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from crossgrad_core.errors import UserError
from crossgrad_core.wording import did_you_mean, listed, sentences

_PREFIXES = ("Input should be ", "Value error, ", "Assertion failed, ")


def as_user_error(
    error: ValidationError, model: type[BaseModel], *, subject: str, prefix: str = "", todo: str
) -> UserError:
    """The first of the validation errors, with the names of the others.

    Args:
        error: What pydantic found.
        model: The model that was validated; its fields are the options that are suggested.
        subject: What has these options, for example `operator cagrad`.
        prefix: Where its options are in a configuration, for example `operator`.
        todo: What the user can do about it.
    """
    details = error.errors(include_url=False)
    first, others = details[0], details[1:]
    more = f"also wrong: {listed(_path(each['loc']) for each in others)}" if others else ""
    options = _options(model, first["loc"][:-1])
    key = _path(first["loc"])
    where = ".".join(part for part in (prefix, key) if part) or subject
    if first["type"] == "extra_forbidden":
        return UserError(
            f"{subject} has no option {key!r}",
            where=where,
            expected=f"one of {listed(options)}" if options else "no options; it has none",
            todo=sentences(did_you_mean(str(first["loc"][-1]), options), more, todo),
        )
    return UserError(
        f"option {key} of {subject} is not valid" if key else f"{subject} is not valid",
        where=where,
        expected=_expected(first),
        found=_found(first),
        todo=sentences(more, todo),
    )


def _path(location: Iterable[int | str]) -> str:
    return ".".join(str(part) for part in location)


def _options(model: type[BaseModel], location: Iterable[int | str]) -> list[str]:
    """Field names of the model at a place inside `model`; empty where there is none."""
    for part in location:
        field = model.model_fields.get(str(part))
        inner = field.annotation if field else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return list(model.model_fields)


def _expected(detail: ErrorDetails) -> str:
    if detail["type"] == "missing":
        return "a value; there is no default"
    text = detail["msg"]
    for prefix in _PREFIXES:
        text = text.removeprefix(prefix)
    return text


def _found(detail: ErrorDetails) -> str:
    if detail["type"] == "missing":
        return "nothing"
    value = detail["input"]
    return f"{value!r} ({type(value).__name__})"
