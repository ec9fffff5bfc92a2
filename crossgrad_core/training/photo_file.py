"""The values of photos as JSON: written beside the trained scene, and read to start from."""

import json
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.text_files import read_json
from crossgrad_core.wording import listed

#: The file in a run's folder.
FILE: Final = "exposure.json"
#: Version of the layout; raised whenever an older reader could misread a newer file.
FORMAT: Final = 1
_TODO = "name the exposure.json of a run, or leave --exposure-from out"


def write_values(
    path: Path, exposure: str, photos: Sequence[str], values: Mapping[str, Tensor]
) -> None:
    """Writes the values of photos.

    Args:
        path: The file.
        exposure: Name of the exposure whose values they are.
        photos: Names of the photos.
        values: Name of a parameter -> [P, ...].

    Raises:
        UserError: The disk is full, or the folder may not be written to.
    """
    plain = {name: each.detach().cpu().tolist() for name, each in values.items()}
    rows = {
        photo: {name: each[row] for name, each in plain.items()} for row, photo in enumerate(photos)
    }
    content = {"format": FORMAT, "exposure": exposure, "photos": rows}
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def read_values(path: Path, like: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Name of a photo -> name of a parameter -> its value.

    Args:
        path: The file.
        like: Name -> [P, ...] values as the run has them: names and shapes that the file must have.

    Raises:
        UserError: It cannot be read, or holds the values of another exposure.
    """
    content = _content(path)
    exposure = content.get("exposure", "another one")
    found = {}
    for photo, values in content["photos"].items():
        if not isinstance(values, dict) or values.keys() != like.keys():
            names = listed(values) if isinstance(values, dict) else repr(values)
            raise _misfit(path, exposure, listed(like), f"{names} of photo {photo}")
        found[photo] = {
            name: _value(path, exposure, values[name], each[0]) for name, each in like.items()
        }
    return found


def _content(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (FileNotFoundError, ValueError) as error:
        raise UserError(
            "the values of photos cannot be read", where=path, found=str(error), todo=_TODO
        ) from error
    if not isinstance(content, dict) or not _is_of_photos(content):
        raise UserError(
            "the file does not hold values of photos",
            where=path,
            expected=f"an object with the format {FORMAT} and photos",
            found=str(list(content))[:80] if isinstance(content, dict) else type(content).__name__,
            todo=_TODO,
        )
    return content


def _is_of_photos(content: Mapping[str, Any]) -> bool:
    return content.get("format") == FORMAT and isinstance(content.get("photos"), dict)


def _value(path: Path, exposure: object, plain: object, like: Tensor) -> Tensor:
    try:
        value = torch.tensor(plain, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _misfit(path, exposure, "numbers", str(plain)[:80]) from error
    if value.shape != like.shape or not all(map(isfinite, value.flatten().tolist())):
        shape = f"finite numbers of shape {list(like.shape)}"
        raise _misfit(path, exposure, shape, str(plain)[:80])
    return value


def _misfit(path: Path, exposure: object, expected: str, found: str) -> UserError:
    return UserError(
        "the values of photos do not fit the exposure of the run",
        where=path,
        expected=expected,
        found=f"{found}, written by exposure {exposure}",
        todo=f"choose --exposure {exposure}, or leave --exposure-from out",
    )
