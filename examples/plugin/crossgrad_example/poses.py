"""A reader for photos with poses in one JSON file."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.raw import RawScene, RawView

#: Name of the pose file in a scene. The file contains a list of `{"name", "size": [w, h],
#: "pinhole": [fx, fy, cx, cy], "world_to_camera": 4 x 4}`. The photos are in the folder images/.
POSES = "poses.json"


class Poses(Reader):
    """A reader for photos with poses in one JSON file, without points (`--init random`)."""

    @override
    def accepts(self, path: Path) -> bool:
        return (path / POSES).is_file()

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        try:
            views = tuple(
                _view(each) for each in json.loads((path / POSES).read_text(encoding="utf-8"))
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                "the poses cannot be read",
                where=path / POSES,
                found=f"{type(error).__name__}: {error}",
                todo="name the folder of a scene with images/ and the poses of its photos",
            ) from error
        points, colors = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
        return build_scene(RawScene(path, path / "images", views, points, colors), options)


def _view(pose: Mapping[str, Any]) -> RawView:
    width, height = pose["size"]
    return RawView(
        name=pose["name"],
        calibration=Calibration("PINHOLE", int(width), int(height), tuple(pose["pinhole"])),
        world_to_camera=np.array(pose["world_to_camera"], dtype=np.float64).reshape(4, 4),
        seen=np.zeros(0, dtype=np.int64),
    )
