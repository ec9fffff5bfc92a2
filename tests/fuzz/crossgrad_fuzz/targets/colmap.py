"""COLMAP models, binary and text, and the views that are made of them."""

import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from support.scenes import write_tiny_scene

from crossgrad_fuzz.case import Case, load
from crossgrad_fuzz.mutate import NUMBERS, at_offsets, matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.readers import colmap
from crossgrad_plugins.readers.colmap import _make_views
from crossgrad_plugins.readers.colmap_files import binary
from crossgrad_plugins.readers.colmap_files import model as _colmap_model
from crossgrad_plugins.readers.colmap_files.model import count_images, has_model, read_model

_CAMERA, _IMAGE, _POINT, _OBSERVATION = 24, 64, 43, 24
_MODELS = ("PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE")


def _files(*, text: bool, model: str, points: int = 6) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_tiny_scene(
            folder, views=3, width=24, height=16, points=points, model=model, text=text
        )
        return load(folder / "sparse" / "0")


def files(*, text: bool, model: str = "PINHOLE", points: int = 6) -> dict[str, bytes]:
    """The files of a small model; those that crossgrad does not read are left out."""
    found = _files(text=text, model=model, points=points)
    suffix = "txt" if text else "bin"
    return {f"{n}.{suffix}": found[f"{n}.{suffix}"] for n in ("cameras", "images", "points3D")}


def _parse(folder: Path) -> None:
    assert count_images(folder) >= 0
    if not has_model(folder):
        return
    model = read_model(folder)
    count = len(model.points)
    assert model.points.shape == (count, 3)
    assert model.colors.shape == (count, 3)
    assert model.point_ids.shape == (count,)
    for view in _make_views(model, folder):
        assert view.world_to_camera.shape == (4, 4)
        assert np.isfinite(view.world_to_camera).all()
        assert ((view.seen >= 0) & (view.seen < count)).all()


def fields(data: bytes) -> list[tuple[int, int, str]]:
    """Fields of any of the three files, by trying its layout; wrong ones do no harm."""
    return [(0, 8, "i"), *_camera_fields(data), *_image_fields(data), *_point_fields(data)]


def _camera_fields(data: bytes) -> list[tuple[int, int, str]]:
    fields, at = [], 8
    while at + _CAMERA <= len(data) and len(fields) < 100:
        fields += [(at, 4, "i"), (at + 4, 4, "i"), (at + 8, 8, "i"), (at + 16, 8, "i")]
        fields += [(at + _CAMERA + 8 * i, 8, "f") for i in range(4)]
        at += _CAMERA + 32
    return fields


def _image_fields(data: bytes) -> list[tuple[int, int, str]]:
    fields, at = [], 8
    while at + _IMAGE <= len(data) and len(fields) < 200:
        end = data.find(b"\0", at + _IMAGE)
        if end < 0 or end + 9 > len(data):
            break
        fields += [(at, 4, "i"), *((at + 4 + 8 * i, 8, "f") for i in range(7)), (at + 60, 4, "i")]
        fields += [(at + _IMAGE, end - at - _IMAGE, "s"), (end + 1, 8, "i")]
        (count,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + _OBSERVATION * min(count, len(data))
    return fields


def _point_fields(data: bytes) -> list[tuple[int, int, str]]:
    fields, at = [], 8
    while at + _POINT + 8 <= len(data) and len(fields) < 200:
        fields += [(at, 8, "i"), *((at + 8 + 8 * i, 8, "f") for i in range(3)), (at + 43, 8, "i")]
        (length,) = struct.unpack_from("<Q", data, at + _POINT)
        at += _POINT + 8 + 8 * min(length, len(data))
    return fields


def _binary() -> Sequence[Case]:
    models = [files(text=False, model=model) for model in _MODELS]
    return [*models, _two_cameras(models[0]), files(text=False, points=0), _without_points()]


def _two_cameras(case: Case) -> Case:
    """A second camera, which no image has."""
    first = case["cameras.bin"][8:]
    second = struct.pack("<I", 7) + first[4:]
    return {**case, "cameras.bin": struct.pack("<Q", 2) + first + second}


def _text() -> Sequence[Case]:
    models = [files(text=True, model=model) for model in _MODELS]
    return [*models, files(text=False), _without_text_points()]


def _without_points() -> Case:
    case = files(text=False)
    del case["points3D.bin"]
    return case


def _without_text_points() -> Case:
    return files(text=True, points=0)


#: Photos are paired elsewhere; here only what is in the files counts.
_READER = ("ColmapReader",)
_WORDS = (
    *(b"PINHOLE", b"SIMPLE_PINHOLE", b"OPENCV", b"FULL_OPENCV", b"FOV", b"OPENCV_FISHEYE"),
    *(b"0000.png", b"0001.png", b"../0001.png", b"/0001.png", b"-1", b"18446744073709551615"),
    *(b"# Camera list\n", b"\n\n", b" 1 1 1 1", b"\xff.png"),
)

BINARY = Target(
    name="colmap-binary",
    seeds=_binary,
    parse=_parse,
    parser={
        _colmap_model: ("count_images",),
        binary: (),
        colmap: _READER,
    },
    words=(b"\0", b"0000.png\0", b"0001.png\0", b"../x\0", struct.pack("<Q", 2**64 - 1)),
    mutators=(at_offsets(fields),),
)
TEXT = Target(
    name="colmap-text",
    seeds=_text,
    parse=_parse,
    parser={_colmap_model: (), binary: (), colmap: _READER},
    mutators=(matcher(rb"\n(\d+) ", (b"1", b"2", b"3")), matcher(rb" ([-\d.e]+)", NUMBERS)),
    words=_WORDS,
)
TARGETS = (BINARY, TEXT)
