"""XML files of scenes, read with expat behind a guard, and numbers in their elements.

Entities are what makes XML dangerous: they expand without bound and can name other files. They can
only be declared in a document type, so a file that has one is refused before anything in it is
read; the formats have none. Size, depth and number are bounded too, so that a file takes at most
some ten times its size in memory. That needs no further package.
"""

from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, open_file, size_text
from crossgrad_plugins.readers._json import Fields

#: Bytes of a file and of one tag or comment; elements within each other; elements and attributes.
LARGEST: Final = 128 << 20
_LONGEST: Final = 4 << 20
_DEEPEST: Final = 64
_MOST: Final = 2_000_000
_PIECE: Final = 1 << 20
_AGAIN = "export the file again"


class _RefusedError(Exception):
    """The file holds something that is not read."""


class _Builder:
    """Builds a tree from expat's events and refuses what formats of scenes do not need."""

    def __init__(self) -> None:
        self.tree = TreeBuilder()
        self._depth = 0
        self._count = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._count += 1 + len(attributes)
        if self._count > _MOST:
            raise _RefusedError(f"more than {_MOST:,} elements and attributes")
        if self._depth > _DEEPEST:
            raise _RefusedError(f"elements more than {_DEEPEST} deep within each other")
        self.tree.start(tag, attributes)

    def end(self, tag: str) -> None:
        self._depth -= 1
        self.tree.end(tag)

    def doctype(self, name: str, *rest: object) -> None:
        raise _RefusedError("a document type, which may declare entities")


def read_xml(path: Path) -> Element:
    """The root element of an XML file.

    Raises:
        UserError: The file is missing, too large or too deep, is not XML, or has a document type.
    """
    try:
        return _parsed(path)
    except (OSError, expat.ExpatError, LookupError, ValueError, _RefusedError) as error:
        raise UserError(
            "the file cannot be read",
            where=path,
            expected="XML without a document type",
            found=str(error),
            todo=_AGAIN,
        ) from error


def _parsed(path: Path) -> Element:
    builder, parser = _Builder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.tree.data
    parser.StartDoctypeDeclHandler = builder.doctype
    with open_file(path) as file:
        while piece := file.read(_PIECE):
            if file.tell() > LARGEST:
                raise _RefusedError(f"a file of more than {size_text(LARGEST)}")
            parser.Parse(piece, False)
            if file.tell() - parser.CurrentByteIndex > _LONGEST:
                raise _RefusedError(f"a tag or comment of more than {size_text(_LONGEST)}")
    parser.Parse(b"", True)
    return builder.tree.close()


def numbers(element: Element | None, count: int, file: Path, place: str) -> NDArray[np.float64]:
    """[count] numbers in the text of an element.

    Raises:
        UserError: The element is missing, or holds something else.
    """
    words = (element.text or "").split() if element is not None else []
    values: list[object] = []
    for word in words[: count + 1]:
        try:
            values.append(word if "_" in word else float(word))
        except ValueError:
            values.append(word)
    return Fields({"text": values}, file, place).numbers("text", count)
