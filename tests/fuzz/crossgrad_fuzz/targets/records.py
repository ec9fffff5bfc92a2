"""What a run keeps about its scene and its writer, and the gradients that a user gives as text."""

import logging
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from crossgrad_core.run.results import lock, scene_file
from crossgrad_core.run.results.lock import Holder
from crossgrad_core.run.results.scene_file import check_scene, write_scene
from crossgrad_core.scene import fingerprint as differences
from crossgrad_core.scene.fingerprint import (
    FileMark,
    Fingerprint,
    FrameMark,
    PointsMark,
    ViewMark,
    Weight,
)
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target
from crossgrad_operators.stress.search import repeat
from crossgrad_operators.stress.search.repeat import read_rows

_SCENE, _LOCK, _ROWS = scene_file.FILE, lock.FILE, "rows.txt"
_CAMERA = (24.0, 16.0, 20.0, 20.0, 12.0, 8.0)
_PHOTO = FileMark(bytes=1000, sha256="ab" * 32)


def _fingerprint(**views: tuple[bool, FileMark | None]) -> Fingerprint:
    marks = {
        name: ViewMark(trained=trained, camera=_CAMERA, photo=_PHOTO, mask=mask)
        for name, (trained, mask) in views.items()
    }
    return Fingerprint(
        frame=FrameMark(offset=(1.0, 2.0, 3.0), scale=0.5),
        points=PointsMark(count=9, moments=(0.0, 1.0)),
        lists={"train_list.txt": "cd" * 32},
        views=marks,
    )


#: The scene as it is now.
_NOW = _fingerprint(a=(True, None), b=(True, _PHOTO), c=(False, None))


@cache
def _scene_seeds() -> Sequence[Case]:
    others = (
        _fingerprint(a=(True, _PHOTO), b=(False, _PHOTO), d=(True, None)),
        _fingerprint(a=(True, None), b=(True, _PHOTO)).model_copy(update={"lists": {}}),
    )
    return [{_SCENE: _written(each)} for each in (_NOW, *others)]


def _written(fingerprint: Fingerprint) -> bytes:
    with TemporaryDirectory() as place:
        write_scene(Path(place), fingerprint)
        return (Path(place) / _SCENE).read_bytes()


def _parse_scene(folder: Path) -> None:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # the note on a file that tells nothing
    try:
        for note in check_scene(folder, _NOW, Weight.PLACE, accept=True):
            note.encode()
        check_scene(folder, _NOW, Weight.HELD_OUT, accept=True)
        check_scene(folder, _NOW, Weight.PLACE, accept=False)
    finally:
        logging.disable(before)


def _lock_seeds() -> Sequence[Case]:
    text = '{"pid": 7, "host": "elsewhere", "since": "2026-11-22 10:00:00", "doing": "training"}'
    return [{_LOCK: text.encode()}, {_LOCK: text.replace("elsewhere", _host()).encode()}]


def _host() -> str:
    return Holder.me("").host


def _parse_lock(folder: Path) -> None:
    path = folder / _LOCK
    if path.is_file():
        with path.open("rb") as file:
            raise lock._in_use(folder, lock._read(file))


def _row_seeds() -> Sequence[Case]:
    return [{_ROWS: b"[[1,2],[3,4]]"}, {_ROWS: b"[[-1.5, 2e-30, 0], [1, 2, 3.25], [0, 0, 0]]"}]


def _parse_rows(folder: Path) -> None:
    path = folder / _ROWS
    # As a command line is handed over.
    text = path.read_bytes().decode("utf-8", "surrogateescape") if path.is_file() else ""
    for dtype in (torch.float32, torch.float64):
        rows = read_rows(text, dtype).exact_head
        assert rows.ndim == 2
        assert rows.size > 0
        assert np.isfinite(rows).all()


_JSON = (
    *(b"{", b"}", b"[", b"]", b"[" * 5000, b'"a": ', b",", b"NaN", b"Infinity", b"1e999", b"null"),
    *(b"true", b'"\\ud800"', b'"\\u0000"', b"9" * 400, b'"x"', b'\\"'),
)

SCENE_FILE = Target(
    name="scene-file",
    seeds=_scene_seeds,
    parse=_parse_scene,
    parser={scene_file: ("write_scene",), differences: ()},
    words=(*_JSON, b'"a": {', b'"c": {', b'"trained": false', b'"trained": true', b'"mask": null'),
    mutators=(
        matcher(rb'": *(-?[\d.]+)', NUMBERS),
        matcher(rb"[\[ ](-?[\d.]+)[,\]]", NUMBERS),
        matcher(rb'"([\w.]+)": ', (b"a", b"b", b"c", b"d", b"views", b"scale", b"mask")),
        matcher(rb"(true|false|null)", (b"true", b"false", b"null")),
    ),
)
LOCK = Target(
    name="lock",
    seeds=_lock_seeds,
    parse=_parse_lock,
    parser={lock: ("locked", "writer_of", "_take", "_lock", "_write", "Holder.me")},
    words=(*_JSON, b'"pid"', b'"host"', b'"since"', b'"doing"'),
)
ROWS = Target(
    name="rows",
    seeds=_row_seeds,
    parse=_parse_rows,
    parser={repeat: ("run_rows", "_cell")},
    words=(*_JSON, b"[[", b"]]", b"],["),
    mutators=(matcher(rb"(-?[\d.]+)", NUMBERS),),
)
TARGETS = (SCENE_FILE, LOCK, ROWS)
