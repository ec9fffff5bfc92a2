"""XML files of scenes, read by expat with limits, and numbers in their elements.

Entities make XML dangerous, because they can expand without a limit and can name other files. Only
a document type can declare entities. The supported formats have no document type, so a file with a
document type is refused before its content is read. Size, nesting depth and number of elements are
limited too, so that reading needs at most about ten times the file's size in memory.
"""

from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, open_file, size_text
from crossgrad_plugins.readers._json import Fields

#: Limits: bytes of a file, bytes of a tag or comment, nesting depth, and number of elements and
#: attributes.
LARGEST: Final = 128 << 20
_LONGEST: Final = 4 << 20
_DEEPEST: Final = 64
_MOST: Final = 2_000_000
_PIECE: Final = 1 << 20
_AGAIN = "export the file again"


class _RefusedError(Exception):
    """The error for XML content that this module does not accept."""


class _Builder:
    """Builds a tree from expat's events.

    XML features that scene formats do not need are refused.
    """

    def __init__(self) -> None:
        self.tree = TreeBuilder()
        self._depth = 0
        self._count = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._count += 1 + len(attributes)
        if self._count > _MOST:
            raise _RefusedError(f"the file contains more than {_MOST:,} elements and attributes")
        if self._depth > _DEEPEST:
            raise _RefusedError(f"the elements are nested more than {_DEEPEST} levels deep")
        self.tree.start(tag, attributes)

    def end(self, tag: str) -> None:
        self._depth -= 1
        self.tree.end(tag)

    def doctype(self, name: str, *rest: object) -> None:
        raise _RefusedError(
            "the file has a document type, which is not allowed because it may declare entities"
        )


def read_xml(path: Path) -> Element:
    """Return the root element of an XML file.

    Raises:
        UserError: The file is missing, too large, nested too deeply, not XML, or has a document
            type.
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
                raise _RefusedError(f"the file is larger than {size_text(LARGEST)}")
            parser.Parse(piece, False)
            if file.tell() - parser.CurrentByteIndex > _LONGEST:
                raise _RefusedError(f"a tag or comment is longer than {size_text(_LONGEST)}")
    parser.Parse(b"", True)
    return builder.tree.close()


def numbers(element: Element | None, count: int, file: Path, place: str) -> NDArray[np.float64]:
    """Return [count] the numbers in the text of an element.

    Raises:
        UserError: The element is missing, or does not contain the expected numbers.
    """
    words = (element.text or "").split() if element is not None else []
    values: list[object] = []
    for word in words[: count + 1]:
        try:
            values.append(word if "_" in word else float(word))
        except ValueError:
            values.append(word)
    return Fields({"text": values}, file, place).numbers("text", count)
