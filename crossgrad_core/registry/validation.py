"""Conversion of pydantic's validation errors to user errors."""

from collections.abc import Sequence
from types import NoneType, UnionType
from typing import Annotated, TypeAlias, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from crossgrad_core.errors import UserError
from crossgrad_core.wording import did_you_mean, listed, sentences

_Location: TypeAlias = Sequence[int | str]

_PREFIXES = ("Input should be ", "Value error, ", "Assertion failed, ")


def as_user_error(
    error: ValidationError, model: type[BaseModel], *, subject: str, prefix: str = "", todo: str
) -> UserError:
    """Return a user error for the first wrong option; the error also names all other wrong options.

    Args:
        error: The error of pydantic.
        model: The validated model; its fields are the options that are suggested.
        subject: The owner of the options, for example `operator cagrad`.
        prefix: Key of the options in a configuration, for example `operator`.
        todo: Advice for the user.
    """
    details = error.errors(include_url=False)
    first, places = details[0], [_place(model, detail["loc"]) for detail in details]
    option_path, holder = places[0]
    # Join the errors of one option, because pydantic reports one error for each branch of a union.
    branches = [detail for detail, at in zip(details, places, strict=True) if at[0] == option_path]
    key, *others = dict.fromkeys(".".join(parts) for parts, _ in places)
    more = f"also wrong: {listed(others)}" if others else ""
    where = ".".join(part for part in (prefix, key) if part) or subject
    if first["type"] == "extra_forbidden":
        options = list(holder.model_fields) if holder else []
        return UserError(
            f"{subject} has no option {key!r}",
            where=where,
            expected=f"one of {listed(options)}" if options else "no options: it has none",
            todo=sentences(did_you_mean(option_path[-1], options), more, todo),
        )
    return UserError(
        f"option {key} of {subject} is not valid" if key else f"{subject} is not valid",
        where=where,
        expected=", or ".join(dict.fromkeys(_expected(detail) for detail in branches)),
        found=_found(first),
        todo=sentences(more, todo),
    )


def _place(
    model: type[BaseModel], location: _Location
) -> tuple[tuple[str, ...], type[BaseModel] | None]:
    """Return the keys in a pydantic location, and the model that should contain the last key.

    The keys do not include the branches of a union, because the user's input does not contain them.
    """
    parts: list[str] = []
    holder: type[BaseModel] | None = None
    annotation: object = model
    rest = list(location)
    while rest:
        annotation, branches = _unwrapped(annotation)
        if len(branches) > 1:
            label = str(rest.pop(0))
            annotation = next((branch for branch in branches if _name(branch) == label), None)
            continue
        part = str(rest.pop(0))
        parts.append(part)
        holder, annotation = _inside(annotation, part)
    return tuple(parts), holder


def _unwrapped(annotation: object) -> tuple[object, Sequence[object]]:
    """Return an annotation without `Annotated` and `None`, and its branches if it is a union."""
    while True:
        if get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        elif get_origin(annotation) in (Union, UnionType):
            branches = [branch for branch in get_args(annotation) if branch is not NoneType]
            if len(branches) > 1:
                return annotation, branches
            annotation = branches[0]
        else:
            return annotation, ()


def _name(annotation: object) -> str:
    return getattr(_unwrapped(annotation)[0], "__name__", "")


def _inside(annotation: object, part: str) -> tuple[type[BaseModel] | None, object]:
    """Return the model and the annotation of its field `part`.

    For a list, a tuple or a mapping, return None and the annotation of the values.
    """
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get(part)
        return annotation, field.annotation if field else None
    # Return the type of the values of a list, a tuple or a mapping.
    arguments = [argument for argument in get_args(annotation) if argument is not ...]
    return None, arguments[-1] if arguments else None


def _expected(detail: ErrorDetails) -> str:
    if detail["type"] == "missing":
        return "a value, because there is no default"
    if detail["type"] in {"model_type", "dict_type"}:
        return "a mapping of names to values"
    if detail["type"] == "too_short":
        return f"at least {detail.get('ctx', {}).get('min_length')} entries"
    text = detail["msg"]
    for prefix in _PREFIXES:
        text = text.removeprefix(prefix)
    return text


def _found(detail: ErrorDetails) -> str:
    if detail["type"] == "missing":
        return "nothing"
    value = detail["input"]
    return f"{value!r} ({type(value).__name__})"
