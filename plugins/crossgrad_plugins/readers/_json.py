"""JSON files of scenes: limits on size and depth, and typed fields that errors name."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError
from crossgrad_core.plugin import read_json as json_in
from crossgrad_core.scene.raw import FARTHEST

#: Maximum size of a file in bytes. The limit is high, because large reconstructions contain
#: millions of points.
LARGEST: Final = 512 << 20
#: Maximum width or height of a photo, in pixels.
LONGEST_SIDE: Final = 10_000_000
_AGAIN = "correct the file, or export it again"
_LONGEST: Final = 80


@dataclass(frozen=True, eq=False)
class Fields:
    """A JSON object whose fields are checked when they are read.

    Each function that returns a field raises a `UserError` with the file and the field if the field
    is wrong.

    Attributes:
        value: The JSON object.
        file: The file that contains the object.
        place: Position of the object in the file, such as `frames[3]`; empty for the top object.
    """

    value: Mapping[str, object]
    file: Path
    place: str = ""

    @property
    def here(self) -> str:
        """Return the file and the object's position in the file, for error messages."""
        return f"{self.file}: {self.place}"

    def where(self, key: str) -> str:
        """Return the file and the position of a field, for error messages."""
        return f"{self.file}: {self.place}{'.' if self.place else ''}{key}"

    def __contains__(self, key: str) -> bool:
        return self.value.get(key) is not None

    def wrong(self, key: str, expected: str, found: str | None = None) -> NoReturn:
        """Raise an error about a wrong field.

        Raises:
            UserError: Always.
        """
        here = repr(self.value[key])[:_LONGEST] if key in self.value else "the field is missing"
        raise UserError(
            "a field of the scene file cannot be read",
            where=self.where(key),
            expected=expected,
            found=here if found is None else found,
            todo=_AGAIN,
        )

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        if key not in self and default is not None:
            return default
        number = _number(self.value.get(key))
        if number is None:
            self.wrong(key, f"a finite number of at most {FARTHEST:g}")
        return number

    def positive(self, key: str) -> float:
        """Return a finite number above zero."""
        number = self.number(key)
        if number <= 0.0:
            self.wrong(key, "a number above zero")
        return number

    def side(self, key: str) -> int:
        """Return the width or height of a photo as a whole number of pixels."""
        number = self.number(key)
        if number != int(number) or not 1 <= number <= LONGEST_SIDE:
            self.wrong(key, f"a whole number from 1 to {LONGEST_SIDE:,}")
        return int(number)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self.value.get(key, default)
        if not isinstance(value, str) or not value:
            self.wrong(key, "a text")
        return value

    def numbers(self, key: str, *shape: int) -> NDArray[np.float64]:
        """Return nested lists of finite numbers with the given shape."""
        flat = list(_flat(self.value.get(key), shape))
        numbers = [number for number in map(_number, flat) if number is not None]
        if len(numbers) != len(flat) or len(flat) != math.prod(shape):
            size = " x ".join(map(str, shape))
            self.wrong(key, f"a list of {size} finite numbers")
        return np.array(numbers, dtype=np.float64).reshape(shape)

    def texts(self, key: str) -> list[str]:
        """Return a list of texts."""
        value = self.value.get(key)
        if not isinstance(value, list):
            self.wrong(key, "a list of strings")
        texts = [item for item in value if isinstance(item, str)]
        if len(texts) != len(value):
            self.wrong(key, "a list of strings")
        return texts

    def inner(self, key: str) -> "Fields":
        """Return a field that is an object."""
        return self._child(self.value.get(key), key)

    def members(self, key: str) -> dict[str, "Fields"]:
        """Return the objects inside a field that is an object, by name."""
        value = self.value.get(key)
        if not isinstance(value, dict):
            self.wrong(key, "an object")
        return {name: self._child(item, f"{key}.{name}") for name, item in value.items()}

    def items(self, key: str) -> list["Fields"]:
        """Return the objects of a list."""
        value = self.value.get(key)
        if not isinstance(value, list):
            self.wrong(key, "a list of objects")
        return [self._child(item, f"{key}[{i}]") for i, item in enumerate(value)]

    def _child(self, value: object, name: str) -> "Fields":
        place = f"{self.place}{'.' if self.place else ''}{name}"
        if not isinstance(value, dict):
            raise UserError(
                "a field of the scene file cannot be read",
                where=f"{self.file}: {place}",
                expected="an object",
                found=repr(value)[:_LONGEST],
                todo=_AGAIN,
            )
        return Fields(value, self.file, place)


def read_json(path: Path) -> object:
    """Return the value of a JSON file in UTF-8, with or without a byte order mark.

    Raises:
        UserError: The file is missing, too large, nested too deeply, or not JSON.
    """
    try:
        return json_in(path, LARGEST)
    except FileNotFoundError as error:
        raise UserError(
            "a file that this scene format needs is missing",
            where=path,
            todo="name another scene, or the --reader of its format (`auto` detects the format)",
        ) from error
    except ValueError as error:
        raise _unreadable(path, str(error)) from error


def read_object(path: Path) -> Fields:
    """Return the object in a JSON file.

    Raises:
        UserError: The file is missing, too large, nested too deeply, not JSON, or does not contain
            an object.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise _unreadable(path, repr(value)[:_LONGEST], "an object")
    return Fields(value, path)


def _unreadable(path: Path, found: str, expected: str = "JSON") -> UserError:
    return UserError(
        "the file cannot be read", where=path, expected=expected, found=found, todo=_AGAIN
    )


def _number(value: object) -> float | None:
    """Return a number if it is finite and not too large, else None. A boolean value gives None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # Compare before the conversion to float, because whole numbers in JSON can have any number of
    # digits.
    return float(value) if -FARTHEST <= value <= FARTHEST else None


def _flat(value: object, shape: tuple[int, ...]) -> Iterator[object]:
    """Yield the values of nested lists with this shape. Lists of other lengths yield nothing."""
    if not shape:
        yield value
    elif isinstance(value, list) and len(value) == shape[0]:
        for item in value:
            yield from _flat(item, shape[1:])
