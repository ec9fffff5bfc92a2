"""Repaired defects, put back one at a time: a search that does not find them is worth nothing."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import BinaryIO

import numpy as np

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import pillow, shapes
from crossgrad_core.scene.photos.headers import PhotoHeader
from crossgrad_core.system import ply_table, yaml_values
from crossgrad_core.system.ply_table import Element, Header
from crossgrad_fuzz.targets import photos
from crossgrad_plugins.exporters import ply_file as ply


@dataclass(frozen=True)
class Defect:
    """A repaired function, and what it was before.

    Attributes:
        target: Name of the target that must find it.
        patches: (module, name, what it was).
    """

    target: str
    patches: tuple[tuple[ModuleType, str, object], ...]

    @contextmanager
    def put_back(self) -> Iterator[None]:
        """The defect is there inside."""
        repaired = [(module, name, getattr(module, name)) for module, name, _ in self.patches]
        for module, name, former in self.patches:
            setattr(module, name, former)
        try:
            yield
        finally:
            for module, name, value in repaired:
                setattr(module, name, value)


def _read_ascii(
    file: BinaryIO, path: Path, header: Header, vertex: Element, before: list[Element]
) -> dict[str, np.ndarray]:
    names = [name for name, _ in vertex.fields or ()]
    skip = sum(item.count for item in before)
    lines = list(islice(file, skip, skip + vertex.count))
    if len(lines) < vertex.count:
        raise ply_table._truncated(path, f"{vertex.count:,} lines of vertices", f"{len(lines):,}")
    try:
        table = np.array([line.split() for line in lines], dtype=np.float64)
        table = table.reshape(vertex.count, len(names))
    except ValueError as error:
        raise ply_table._malformed(path, f"a line that is not {len(names)} numbers") from error
    return {name: table[:, i] for i, name in enumerate(names)}


def _no_way_out(path: Path, header: PhotoHeader, max_size: int | None) -> int:
    pixels = header.width * header.height
    if pixels <= pillow.MOST_PIXELS:
        return 1
    found = f"Image size ({pixels} pixels) exceeds limit of {pillow.MOST_PIXELS} pixels"
    raise UserError("the photo cannot be read", where=path, found=found)


def _any_digits(text: str) -> bool:
    return text.isdigit()


def _nothing_required(count: int, path: Path) -> None:
    """An empty file passed."""


_MATCHER: Callable[[str], bool] = _any_digits
DEFECTS: dict[str, Defect] = {
    "PLY counts in digits that `int` does not know, or in too many": Defect(
        "ply", ((ply_table, "_COUNT", SimpleNamespace(fullmatch=_MATCHER)),)
    ),
    "PLY counts above 2^63": Defect(
        "ply",
        ((ply_table, "_COUNT", re.compile("[0-9]{1,20}")), (ply_table, "_read_ascii", _read_ascii)),
    ),
    "PLY files of 0 vertices": Defect("ply", ((ply, "_require_gaussians", _nothing_required),)),
    "YAML alias bombs": Defect(
        "settings", ((yaml_values, "MOST_VALUES", 10**12), (yaml_values, "DEEPEST", 10**6))
    ),
    "photos of too many pixels without a way out": Defect(
        "photo-headers",
        (
            (shapes, "choose_reduction", _no_way_out),
            (photos, "choose_reduction", _no_way_out),
        ),
    ),
}
