"""Files like `transforms.json`: frames with a pose in OpenGL's axes, and lens parameters.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html for fields and axes;
https://github.com/NVlabs/instant-ngp, `docs/nerf_dataset_tips.md`, for `camera_angle_x` and
`rolling_shutter`. Pixel centres are at +0.5, because principal points are copied from COLMAP.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import is_file
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.headers import read_header
from crossgrad_core.scene.raw import RawView
from crossgrad_plugins.georeference.frames import SAME, Frame3D, rotation_of
from crossgrad_plugins.readers._cameras import Frame, from_opengl, refuse_lens, refuse_term
from crossgrad_plugins.readers._inside import Inside, shared_folder
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._raw import raw_view

_RADIAL: Final = ("k1", "k2", "k3", "k4")
_TANGENTIAL: Final = ("p1", "p2")
_PERSPECTIVE: Final = frozenset(
    {"PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
)
_FISHEYE: Final = frozenset({"OPENCV_FISHEYE", "FISHEYE"})
#: Pairs of groups of fields; both groups of a pair give one quantity.
_WAYS: Final = (
    (("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y")),
    ((*_RADIAL, *_TANGENTIAL), ("distortion_params",)),
)


@dataclass(frozen=True, eq=False)
class Posed:
    """A photo with its pose: one frame of a file.

    Attributes:
        photo: Name of the photo, relative to the scene.
        calibration: Calibration of the photo's lens.
        pose: [4, 4] world to camera.
        mask: The mask file that the frame names, or None.
    """

    photo: str
    calibration: Calibration
    pose: NDArray[np.float64]
    mask: Path | None = None


def photo_name(inside: Inside, text: str, where: str, base: str) -> str:
    """Return the photo that a file names.

    A name without a suffix means a PNG file, as in NeRF's files.

    Args:
        inside: The files of the scene.
        text: The name in the file.
        where: The field that contains the name.
        base: Folder of the file, relative to the scene.

    Raises:
        UserError: The name leads out of the scene.
    """
    name = inside.found(text, where, base, inside.photos)
    bare = not PurePosixPath(name).suffix
    if not is_file(inside.scene / name) and (bare or is_file(inside.scene / f"{name}.png")):
        name += ".png"
    return name


def read_frame(
    inside: Inside, frame: Fields, whole: Fields, base: str = "", world: Frame3D = SAME
) -> Posed:
    """Return a frame from its fields `file_path` and `transform_matrix`.

    Args:
        inside: The files of the scene.
        frame: The frame.
        whole: The whole file, with fields that apply to all frames. A field of the frame overrides
            the file's field.
        base: Folder of the file, relative to the scene.
        world: Transform from the world of the file to the world of the scene.

    Raises:
        UserError: A field is missing or wrong.
    """
    photo = photo_name(inside, frame.text("file_path"), frame.where("file_path"), base)
    mask = None
    if "mask_path" in frame:
        where = frame.where("mask_path")
        name = inside.found(frame.text("mask_path"), where, base, inside.masks)
        mask = _existing(inside.scene / name, frame)
    matrix = transform_of(frame, "transform_matrix")
    rotation = rotation_of(matrix[:, :3])
    if rotation is None:
        frame.wrong("transform_matrix", "an orthonormal, right-handed rotation and a translation")
    calibration = read_lens(inside, frame, whole, photo)
    return Posed(photo, calibration, from_opengl(rotation, matrix[:, 3], world), mask)


def transform_of(fields: Fields, key: str) -> NDArray[np.float64]:
    """Return the first three rows [3, 4] of a matrix that has three or four rows."""
    rows = fields.value.get(key)
    count = 4 if isinstance(rows, list) and len(rows) == 4 else 3  # noqa: PLR2004 - homogeneous
    return fields.numbers(key, count, 4)[:3]


def read_lens(inside: Inside, frame: Fields, whole: Fields, photo: str) -> Calibration:
    """Return the lens parameters of a frame.

    If the file gives no image size, the size of the photo is used. A field of the frame overrides
    the field of the file with this name. Some quantities can be given by different fields. If the
    frame gives a quantity, the file's other fields for this quantity are ignored, because they
    describe another lens.

    Raises:
        UserError: A field is missing or wrong, or the lens cannot be undistorted.
    """
    shared = _completing(frame, whole)

    def holder(key: str) -> Fields:
        return frame if key in frame else shared

    def number(key: str, default: float | None = None) -> float:
        return holder(key).number(key, default)

    shutter = holder("rolling_shutter")
    if "rolling_shutter" in shutter and shutter.numbers("rolling_shutter", 4).any():
        raise refuse_lens("a camera with a rolling shutter", shutter.where("rolling_shutter"))
    size = _size(inside, holder, photo)
    lens = _frame(size, holder, number)
    radial, tangential = _terms(holder, number)
    frame_is_fisheye, named = _says_fisheye(frame), holder("camera_model")
    if _says_fisheye(whole) if frame_is_fisheye is None else frame_is_fisheye:
        return lens.fisheye(radial)
    model = named.text("camera_model", "PERSPECTIVE").upper()
    if model not in _PERSPECTIVE | _FISHEYE:
        raise refuse_lens(f"camera model {model}", named.where("camera_model"))
    if radial[3]:
        raise refuse_term("k4", radial[3], holder("k4").where("k4"))
    return lens.brown(radial[:3], tangential)


def _completing(frame: Fields, whole: Fields) -> Fields:
    """Return the file, reduced to the fields that may complete a frame."""
    others = [other for both in _WAYS for way, other in (both, both[::-1])
              if any(key in frame for key in way)]  # fmt: skip
    frame_is_fisheye = _says_fisheye(frame)
    if frame_is_fisheye is not None and frame_is_fisheye != bool(_says_fisheye(whole)):
        others += _WAYS[1]  # Remove distortion parameters of another kind of lens.
    hidden = frozenset[str]().union(*others)
    return replace(whole, value={k: v for k, v in whole.value.items() if k not in hidden})


def _says_fisheye(fields: Fields) -> bool | None:
    """Return True if the lens is declared as fisheye, False if it is declared as another lens.

    Return None if no lens is declared.
    """
    if "camera_model" not in fields and "is_fisheye" not in fields:
        return None
    model = fields.text("camera_model", "PERSPECTIVE").upper()
    return model in _FISHEYE or fields.value.get("is_fisheye") is True


def _size(inside: Inside, holder: Callable[[str], Fields], photo: str) -> tuple[int, int]:
    if "w" in holder("w") and "h" in holder("h"):
        return holder("w").side("w"), holder("h").side("h")
    there = is_file(inside.scene / photo)
    header = read_header(inside.scene / (photo if there else inside.photos.find(photo) or photo))
    return header.width, header.height


def _frame(
    size: tuple[int, int],
    holder: Callable[[str], Fields],
    number: Callable[[str, float | None], float],
) -> Frame:
    """Return focal lengths and principal point.

    Focal lengths can be given in pixels or as angles of view. Without a principal point, the middle
    of the image is used.
    """
    width, height = size
    across = _focal(holder, "fl_x", "camera_angle_x", width)
    down = _focal(holder, "fl_y", "camera_angle_y", height)
    if across is None:
        # If both focal lengths are missing, the error names the horizontal one.
        other = "camera_angle_y" if "camera_angle_y" in holder("camera_angle_y") else "fl_y"
        holder(other).wrong("fl_x", "a focal length in pixels, or camera_angle_x in radians")
    return Frame(
        *(width, height, across, across if down is None else down),
        *(number("cx", width / 2.0), number("cy", height / 2.0)),
    )


def _focal(holder: Callable[[str], Fields], name: str, angle_name: str, side: int) -> float | None:
    if name in holder(name):
        return holder(name).positive(name)
    if angle_name not in holder(angle_name):
        return None
    angle = holder(angle_name).number(angle_name)
    if not 0.0 < angle < math.pi:
        holder(angle_name).wrong(angle_name, "an angle of view above 0 and below pi, in radians")
    return 0.5 * side / math.tan(0.5 * angle)


def _terms(
    holder: Callable[[str], Fields], number: Callable[[str, float | None], float]
) -> tuple[Sequence[float], Sequence[float]]:
    """Return k1 to k4, p1 and p2, from single fields or from a list in this order."""
    fields = holder("distortion_params")
    if "distortion_params" in fields:
        terms = fields.numbers("distortion_params", 6).tolist()
        return terms[:4], terms[4:]
    return [number(key, 0.0) for key in _RADIAL], [number(key, 0.0) for key in _TANGENTIAL]


def raw_views(frames: Sequence[Posed]) -> tuple[str, tuple[RawView, ...]]:
    """Return the photo folder (`.` for the scene's own), and views named relative to it."""
    images = shared_folder(frame.photo for frame in frames)
    start = 0 if images == "." else len(images) + 1
    return images, tuple(
        raw_view(frame.photo[start:], frame.calibration, frame.pose, frame.mask) for frame in frames
    )


def _existing(path: Path, frame: Fields) -> Path:
    if not is_file(path):
        frame.wrong("mask_path", "an existing mask", f"no file {path}")
    return path
