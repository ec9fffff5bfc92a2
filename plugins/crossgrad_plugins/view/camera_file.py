"""Camera paths: keyframes of a user, joined to a smooth path in the format of nerfstudio."""

from collections.abc import Sequence
from json import dumps
from math import degrees
from pathlib import Path
from typing import Any, Final

import numpy as np

from crossgrad_core.commands import text_bytes, write_atomically
from crossgrad_core.plugin import Camera, Similarity
from crossgrad_plugins.view.cameras import fov_of

#: Frames per second of a path, and seconds between two keyframes.
_FPS, _SECONDS = 24, 2
_NAME: Final = "camera_path"


def write_camera_path(folder: Path, keyframes: Sequence[Camera], similarity: Similarity) -> Path:
    """Write a path through at least two keyframes to a new file, and return the file.

    Positions follow a cubic spline, rotations the shortest arcs. All frames have the size of the
    last keyframe, with even sides, because video encoders need even sides.

    Args:
        folder: Folder of the file.
        keyframes: Cameras in the local frame of `similarity`.
        similarity: Maps the local frame to input coordinates, the coordinates of the file.

    Raises:
        UserError: The folder is not writable, or the disk is full.
    """
    number = 1
    while (path := folder / f"{_NAME}{f'-{number}' * (number > 1)}.json").exists():
        number += 1
    write_atomically(path, text_bytes(dumps(camera_path(keyframes, similarity))))
    return path


def camera_path(keyframes: Sequence[Camera], similarity: Similarity) -> dict[str, Any]:
    """Return the content of the file; see `write_camera_path`."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    keys = np.arange(len(keyframes))
    times = np.linspace(0, len(keyframes) - 1, (len(keyframes) - 1) * _FPS * _SECONDS + 1)
    centers = similarity.to_input(np.stack([camera.center.numpy() for camera in keyframes]))
    places = CubicSpline(keys, centers, bc_type="natural")(times)
    poses = np.stack([camera.world_to_camera[:3, :3].numpy().T for camera in keyframes])
    rotations = Slerp(keys, Rotation.from_matrix(poses))(times).as_matrix()
    fovs = np.interp(times, keys, [degrees(fov_of(camera)) for camera in keyframes])
    width, height = (max(2, side // 2 * 2) for side in (keyframes[-1].width, keyframes[-1].height))
    frames = []
    for place, rotation, fov in zip(places, rotations, fovs, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation * np.array([1.0, -1.0, -1.0])
        matrix[:3, 3] = place
        frames.append(
            {
                "camera_to_world": matrix.ravel().tolist(),
                "fov": float(fov),
                "aspect": width / height,
            }
        )
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": _FPS,
        "seconds": (len(times) - 1) / _FPS,
        "camera_path": frames,
    }
