"""Reading of PLY vertices as named columns: ascii or binary, any property order and type."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import size_text
from crossgrad_core.system.input_files import is_file, open_file
from crossgrad_core.wording import listed

#: PLY type name -> numpy type without byte order.
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
# Use a pattern, because `isdigit` would also accept digits of other scripts. More than 18 digits
# are refused, because no file contains 10^18 records.
_COUNT = re.compile(r"[0-9]{1,18}")
_LONGEST_HEADER_LINE = 65_536
_MOST_HEADER_LINES = 10_000


@dataclass(frozen=True)
class Element:
    """An element of a PLY file; `fields` is None if the element has list properties."""

    name: str
    count: int
    fields: tuple[tuple[str, str], ...] | None


@dataclass
class _Draft:
    """An element whose properties are still being read."""

    name: str
    count: int
    fields: dict[str, str] = field(default_factory=dict)
    lists: bool = False

    def done(self) -> Element:
        """Return the finished element."""
        return Element(self.name, self.count, None if self.lists else tuple(self.fields.items()))


@dataclass(frozen=True)
class Header:
    """The contents of a PLY header; `byte_order` is None for ascii files."""

    byte_order: str | None
    elements: tuple[Element, ...]
    comments: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Vertices:
    """The vertices of a PLY file: property name -> [N] column in the file's type, and comments."""

    columns: Mapping[str, NDArray[np.generic]]
    comments: tuple[str, ...]


def read_vertices(path: Path) -> Vertices:
    """Read the element `vertex` of a PLY file.

    Raises:
        UserError: The file is missing, is not a PLY file, has no vertices or ends too early.
    """
    _require_file(path)
    with open_file(path) as file:
        header = _read_header(file, path)
        before: list[Element] = []
        for element in header.elements:
            if element.name == "vertex":
                read = _read_ascii if header.byte_order is None else _read_binary
                return Vertices(read(file, path, header, element, before), header.comments)
            before.append(element)
    raise UserError(
        "the PLY file has no vertices",
        where=path,
        expected="an element named vertex",
        found=listed(element.name for element in header.elements),
        todo="export the Gaussians or points as a PLY file of vertices",
    )


def vertex_properties(path: Path) -> tuple[str, ...]:
    """Return the names of the properties of the element `vertex`, from the header alone.

    Raises:
        UserError: The file is missing or is not a PLY file.
    """
    _require_file(path)
    with open_file(path) as file:
        elements = _read_header(file, path).elements
    fields = (element.fields or () for element in elements if element.name == "vertex")
    return tuple(name for vertex_fields in fields for name, _ in vertex_fields)


def _require_file(path: Path) -> None:
    if not is_file(path):
        other = "a pipe or device instead of a file" if os.path.exists(path) else "nothing"
        raise UserError(
            "the PLY file does not exist",
            where=path,
            found="a folder" if os.path.isdir(path) else other,
            todo="check the path",
        )


def _malformed(path: Path, found: str) -> UserError:
    return UserError(
        "the PLY file cannot be read",
        where=path,
        found=found,
        todo="copy, download or export the file again",
    )


def _read_header(file: BinaryIO, path: Path) -> Header:
    if file.readline(8).strip() != b"ply":
        raise UserError(
            "the file is not a PLY file",
            where=path,
            expected="a first line that contains only ply",
            todo="name a PLY file, such as the point_cloud.ply of a run",
        )
    lines = _header_lines(file, path)
    comments = [line.removeprefix("comment").strip() for line in lines if _keyword(line, "comment")]
    formats = [line.split()[1:2] for line in lines if _keyword(line, "format")]
    if len(formats) != 1 or not formats[0] or formats[0][0] not in _FORMATS:
        raise _malformed(path, f"a header whose format is not one of {', '.join(_FORMATS)}")
    return Header(_FORMATS[formats[0][0]], _elements(lines, path), tuple(comments))


def _keyword(line: str, *words: str) -> bool:
    return line.partition(" ")[0] in words


def _elements(lines: list[str], path: Path) -> tuple[Element, ...]:
    drafts: dict[str, _Draft] = {}
    for line in lines:
        match line.split():
            case ["element", name, count] if _COUNT.fullmatch(count) and name not in drafts:
                drafts[name] = draft = _Draft(name, int(count))
            case ["property", *words] if drafts:
                _add_property(draft, words, path)
            case [("format" | "comment" | "obj_info"), *_] | []:
                pass
            case _:
                raise _malformed(path, f"the header line {line!r}")
    return tuple(draft.done() for draft in drafts.values())


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    lines: list[str] = []
    for _ in range(_MOST_HEADER_LINES):
        raw = file.readline(_LONGEST_HEADER_LINE)
        line = raw.decode("utf-8", errors="replace").strip()
        if line == "end_header":
            return lines
        if not raw.endswith(b"\n"):
            break
        lines.append(line)
    raise _malformed(path, "a header without an end")


def _add_property(draft: _Draft, words: list[str], path: Path) -> None:
    if words[:1] == ["list"]:
        draft.lists = True
        return
    if len(words) != 2 or words[0] not in _TYPES:  # noqa: PLR2004 - a type and a name
        raise _malformed(path, f"the property {' '.join(words)!r}")
    kind, name = words
    if name in draft.fields:
        raise _malformed(path, f"two properties named {name!r}")
    draft.fields[name] = _TYPES[kind]


def _dtype(element: Element, header: Header, path: Path) -> np.dtype[np.void]:
    if element.fields is None:
        raise UserError(
            "the PLY file contains lists among its vertices",
            where=path,
            found=f"list properties in the element {element.name}",
            todo="export the Gaussians or points without faces",
        )
    return np.dtype([(name, f"{header.byte_order}{kind}") for name, kind in element.fields])


def _truncated(path: Path, expected: str, found: str) -> UserError:
    return UserError(
        "the PLY file is incomplete: its end is missing",
        where=path,
        expected=expected,
        found=found,
        todo="copy or export the file again",
    )


def _read_binary(
    file: BinaryIO, path: Path, header: Header, vertex: Element, before: list[Element]
) -> dict[str, NDArray[np.generic]]:
    skip = sum(item.count * _dtype(item, header, path).itemsize for item in before)
    dtype = _dtype(vertex, header, path)
    start = file.tell() + skip
    needed, there = vertex.count * dtype.itemsize, path.stat().st_size - start
    if there < needed:
        found = f"{size_text(max(there, 0))} ({max(there, 0):,} bytes)"
        expected = f"{size_text(needed)} ({needed:,} bytes) for {vertex.count:,} vertices"
        raise _truncated(path, expected, found)
    # Return no columns, because an element without properties contains no data.
    if dtype.itemsize == 0:
        return {}
    file.seek(start)
    rows = np.fromfile(file, dtype=dtype, count=vertex.count)
    return {name: rows[name] for name in dtype.names or ()}


def _read_ascii(
    file: BinaryIO, path: Path, header: Header, vertex: Element, before: list[Element]
) -> dict[str, NDArray[np.generic]]:
    if vertex.fields is None:
        _dtype(vertex, header, path)
    names = [name for name, _ in vertex.fields or ()]
    skip = sum(item.count for item in before)
    # Every line has at least one byte, so an impossible count is refused without reading lines.
    possible = skip + vertex.count <= path.stat().st_size
    lines = list(islice(file, skip, skip + vertex.count)) if possible else []
    if len(lines) < vertex.count:
        found = f"{len(lines):,}" if possible else size_text(path.stat().st_size)
        raise _truncated(path, f"{vertex.count:,} lines of vertices", found)
    try:
        table = _parsed(lines).reshape(vertex.count, len(names))
    except ValueError as error:
        raise _malformed(
            path, f"a vertex line that does not contain {len(names)} numbers"
        ) from error
    return {name: table[:, i] for i, name in enumerate(names)}


def _parsed(lines: list[bytes]) -> NDArray[np.float64]:
    if any(b"_" in line for line in lines):
        raise ValueError("digits are grouped with underscores, which PLY does not allow")
    return np.array([line.split() for line in lines], dtype=np.float64)
