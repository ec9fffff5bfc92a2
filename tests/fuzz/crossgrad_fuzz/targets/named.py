"""Files that options name: camera paths, and values of photos."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.run import camera_path
from crossgrad_core.training import per_image_params
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target

_FILE = "named.json"
#: The functions that read a camera path, and the ones that read a file of values.
_READS_PATH = ("_read", "_camera", "_Frame", "_Path")
_READS = ("read_values", "_content", "_is_of_photos", "_value", "_misfit")
_LIKE = {"gain": torch.zeros(3), "matrix": torch.zeros(3, 2, 2)}
_WORDS = (
    *(b"{", b"}", b"[", b"]", b"[" * 5000, b'"a": ', b",", b"NaN", b"Infinity", b"1e999", b"null"),
    *(b"true", b'"\\ud800"', b"9" * 400, b'"x"', b'\\"', b"\xef\xbb\xbf", b"1e308", b"-0.0"),
)


def _file(content: Any) -> Case:
    return {_FILE: json.dumps(content).encode()}


def _paths() -> Sequence[Case]:
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    turned[:3, 3] = 1.0, 2.0, 3.0
    frames = [{"camera_to_world": m.ravel().tolist(), "fov": 50} for m in (np.eye(4), turned)]
    whole = {"camera_path": frames, "render_width": 30, "render_height": 20}
    return [_file(whole), _file({**whole, "fps": 12.5, "crop": None})]


def _parse_path(folder: Path) -> None:
    found = camera_path._read(folder / _FILE, Similarity(np.ones(3), 0.5))
    assert 0 < found.fps <= 1000
    assert found.cameras
    for camera in found.cameras:
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
        assert np.isfinite(np.array(numbers, dtype=np.float32)).all()
        assert min(numbers) > 0
        assert camera.world_to_camera.float().isfinite().all()
        turn = camera.world_to_camera[:3, :3]
        assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-2)


def _values() -> Sequence[Case]:
    photos = {
        name: {"gain": 0.25, "matrix": [[1.0, 0.0], [0.0, 1.0]]} for name in ("a.jpg", "b/c.jpg")
    }
    version = per_image_params.PHOTO_VALUES_FORMAT
    return [
        _file({"format": version, "exposure": "affine", "photos": photos}),
        _file({"format": version, "photos": {}}),
    ]


def _parse_values(folder: Path) -> None:
    for values in per_image_params.read_values(folder / _FILE, _LIKE).values():
        assert values.keys() == _LIKE.keys()
        for name, value in values.items():
            assert value.shape == _LIKE[name].shape[1:]
            assert value.isfinite().all()


_FORMAT = (
    matcher(rb"[\[ ](-?[\d.]+)[,\]}]", NUMBERS),
    matcher(
        rb": ([^,{}\[\]]+)[,}]", (b"null", b"true", b"[]", b"{}", b'"x"', b"0", b"-1", b"1e999")
    ),
    matcher(rb'"([^"]*)"', (b"fov", b"fps", b"gain", b"photos", b"format", b"a", b"")),
)
PATH = Target(
    name="camera-path",
    seeds=_paths,
    parse=_parse_path,
    parser={camera_path: tuple(name for name in vars(camera_path) if name not in _READS_PATH)},
    words=_WORDS,
    mutators=_FORMAT,
)
VALUES = Target(
    name="photo-values",
    seeds=_values,
    parse=_parse_values,
    parser={per_image_params: tuple(name for name in vars(per_image_params) if name not in _READS)},
    words=_WORDS,
    mutators=_FORMAT,
)
TARGETS = (PATH, VALUES)
