"""Files that are made to fill the memory, each parsed by a process whose memory is bounded.

`python -m support.hostile FOLDER` writes and parses them, one after the other, and prints how each
ended as JSON.
"""

import json
import signal
import struct
import sys
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from crossgrad_fuzz.limits import memory_limit
from PIL import Image

from crossgrad_core.run.camera_path import _read as read_camera_path
from crossgrad_core.run.checkpoint import read_tensors
from crossgrad_core.scene.photos.decode import decode_photo
from crossgrad_core.scene.photos.headers import read_header
from crossgrad_core.scene.split import _read_list as read_list
from crossgrad_core.system import input_files
from crossgrad_core.system.ply_table import read_vertices
from crossgrad_core.system.text_files import read_json, read_rows
from crossgrad_core.system.yaml_values import read_mapping
from crossgrad_core.training.per_image_params import read_values
from crossgrad_plugins.readers import _json, _xml

#: What the address space may grow by, and how long one file may take.
MEBIBYTES, SECONDS = 384, 120
_SIZE = 24 << 20


def _filled(piece: bytes, size: int = _SIZE, head: bytes = b"") -> bytes:
    return head + piece * (size // len(piece))


def _gif() -> bytes:
    """A picture of 65,535 x 65,535 pixels, as its header says."""
    side = struct.pack("<HH", 65535, 65535)
    table = b"\0" * 6
    frame = b",\0\0\0\0" + side + b"\0\2\2\x44\1\0;"
    return b"GIF89a" + side + b"\x80\0\0" + table + frame


@dataclass(frozen=True)
class Hostile:
    """A file and its parser.

    Attributes:
        content: Makes the file.
        parse: Has to end in an error.
    """

    content: Callable[[], bytes]
    parse: Callable[[Path], object]


HOSTILE: Mapping[str, Hostile] = {
    "lists": Hostile(lambda: _filled(b"[],", head=b"["), read_json),
    "objects": Hostile(lambda: _filled(b'"a":{},', head=b"{"), read_json),
    "wide text": Hostile(lambda: _filled("aaaaaaa𝄞".encode(), head=b'"'), read_json),
    "camera path": Hostile(lambda: _filled(b"[],"), lambda path: read_camera_path(path, None)),
    "exposure": Hostile(lambda: _filled(b"[],"), lambda path: read_values(path, {})),
    "poses": Hostile(lambda: _filled(b"[],", 4 * _SIZE, b"["), _json.read_json),
    "table": Hostile(lambda: _filled(b"\n"), lambda path: read_rows(path, "the table", "mend it")),
    "cells": Hostile(lambda: _filled(b"a,"), lambda path: read_rows(path, "the table", "mend it")),
    "returns": Hostile(lambda: _filled(b"\r"), lambda path: read_rows(path, "the table", "mend")),
    "list of views": Hostile(lambda: _filled(b"a\n"), lambda path: read_list(path, ())),
    "settings": Hostile(lambda: _filled(b"[a,"), lambda path: read_mapping(path, "it", "mend it")),
    "attributes": Hostile(lambda: _filled(b' a=""', head=b"<d"), _xml.read_xml),
    "vertices": Hostile(
        lambda: (
            b"ply\nformat ascii 1.0\nelement vertex 99999999999999999\n"
            b"property float x\nend_header\n0\n"
        ),
        read_vertices,
    ),
    "tensors": Hostile(lambda: struct.pack("<Q", 1 << 40) + b"{}", read_tensors),
    "picture": Hostile(_gif, decode_photo),
    "photo": Hostile(lambda: _photo_claiming(60_000), read_header),
}


def _photo_claiming(side: int) -> bytes:
    """A PNG file of one pixel whose header says that it has many."""
    from io import BytesIO
    from zlib import crc32

    file = BytesIO()
    Image.new("RGB", (1, 1)).save(file, format="png")
    content = bytearray(file.getvalue())
    content[16:24] = struct.pack(">II", side, side)
    content[29:33] = struct.pack(">I", crc32(content[12:29]))
    return bytes(content)


@contextmanager
def _alarm(seconds: int) -> Any:
    """Ends the process where something is waited for without an end."""
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def ended(hostile: Hostile, path: Path) -> str:
    """The kind of error in which parsing ended, those of JSON as `ValueError`, or `nothing`."""
    path.write_bytes(hostile.content())
    try:
        with memory_limit(MEBIBYTES), _alarm(SECONDS):
            hostile.parse(path)
    except Exception as error:
        return "ValueError" if isinstance(error, ValueError) else type(error).__name__
    finally:
        path.unlink()
    return "nothing"


def main(folder: Path) -> None:
    """Prints how each file ended, and one of them where no bound is held."""
    found = {name: ended(hostile, folder / "file") for name, hostile in HOSTILE.items()}
    with patch.object(input_files, "GROWS", 1_000_000):
        found["lists without a bound"] = ended(HOSTILE["lists"], folder / "file")
    print(json.dumps(found))  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]))
