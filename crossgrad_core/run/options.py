"""The settings that are options of `crossgrad run`, read from the fields of `RunConfig`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.flags import Flag

#: Types that the command line parses. Values of all other types are read as text, and `RunConfig`
#: validates them.
_OWN_TYPES: Final = (int, float, Path)


@dataclass(frozen=True)
class Option:
    """An option of the command line.

    Attributes:
        path: The setting that the option changes, such as `("data", "split")`.
        flag: Name and appearance of the option on the command line.
        kind: Type of the option.
        help: Help text of the option.
    """

    path: tuple[str, ...]
    flag: Flag
    kind: Any
    help: str

    @property
    def name(self) -> str:
        """The option's name as a keyword: `max_size` for `--max-size`."""
        return self.flag.name or self.path[-1]


def _options(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[Option]:
    for name, field in model.model_fields.items():
        for flag in field.metadata:
            if isinstance(flag, Flag):
                yield Option((*path, name), flag, _kind(field), field.description or "")
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from _options(inner, (*path, name))


def _kind(field: FieldInfo) -> object:
    if get_origin(field.annotation) in {tuple, dict}:
        return list[str]
    kinds = [argument for argument in get_args(field.annotation) if argument is not NoneType]
    kind = kinds[0] if len(kinds) == 1 else field.annotation
    return kind if kind in _OWN_TYPES else str


#: All options in the order of the fields of `RunConfig`.
OPTIONS: Final = tuple(_options(RunConfig))
