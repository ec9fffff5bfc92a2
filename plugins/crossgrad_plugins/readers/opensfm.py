"""Reader of OpenSfM and OpenDroneMap scenes: `reconstruction.json`.

Sources of the format: https://opensfm.org/docs/geometry.html (axes, camera models, pixels),
https://opensfm.org/docs/dataset.html (reconstruction file format). Normalised coordinates are
measured from the middle of the photo. Their unit is the longer side of the photo.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.point_cloud import PointCloud
from crossgrad_core.scene.raw import FARTHEST, RawView
from crossgrad_core.scene.wording import count
from crossgrad_plugins.georeference.frames import SAME
from crossgrad_plugins.georeference.on_earth import OnEarth
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._cameras import Frame, refuse_lens
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields, read_json
from crossgrad_plugins.readers._raw import PhotoNames, raw_scene, raw_view
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder
from crossgrad_plugins.readers.place.place import at, by_gps, origin_of

_BYTE: Final = 255
#: Minimum divisor in place of a rotation angle, in radians. For smaller angles, sine and angle are
#: equal in float64.
_SMALL: Final = 1e-12


class OpenSfmReader(Reader):
    """OpenSfM's `reconstruction.json`, alone or in an OpenDroneMap project.

    If the file contains several reconstructions, the one with the most photos is read. Perspective,
    radial, Brown's and fisheye cameras are undistorted. Scenes with other camera models are
    refused.
    """

    images: str = Field("images", description="folder of the photos within the scene")
    file: str | None = Field(
        None,
        description="reconstruction file within the scene; by default reconstruction.json, also "
        "in opensfm/",
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.opensfm(path, self._names)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        file = self._find(inside)
        chosen, note = _choose(file)
        images = inside.name(self.images, "reader.images")
        cameras = {name: _camera(fields) for name, fields in chosen.members("cameras").items()}
        shots = chosen.members("shots")
        photos = PhotoNames.of(path / images, shots)
        views = tuple(_view(inside, photos, shot, cameras) for shot in shots.items())
        points = _points(chosen)
        head = (
            f"OpenSfM: {count(len(views), 'posed image')}, {count(len(cameras), 'camera')}, "
            f"{count(len(points.positions), 'SfM point')} from {points.source}"
        )
        raw = raw_scene(inside, images, views, points, head, *note)
        scene, place = build_scene(raw, options), _place(chosen)
        return by_gps(scene, raw) if place is None else at(scene, place)

    @property
    def _names(self) -> tuple[str, ...]:
        return _accepts.OPENSFM_FILES if self.file is None else (self.file,)

    def _find(self, inside: Inside) -> Path:
        names = [inside.name(name, "reader.file") for name in self._names]
        there = [name for name in names if (inside.scene / name).is_file()]
        if not there:
            raise UserError(
                "the scene folder contains no OpenSfM reconstruction",
                where=inside.scene,
                expected=" or ".join(names),
                todo="name the project folder of OpenSfM or OpenDroneMap",
            )
        return inside.file(there[0], "reader.file")


def _choose(file: Path) -> tuple[Fields, list[str]]:
    """Return the reconstruction with the most photos, and a note on the other ones."""
    whole = Fields({"reconstructions": read_json(file)}, file)
    models = whole.items("reconstructions")
    if not models:
        whole.wrong("reconstructions", "a list that contains a reconstruction", "an empty list")
    counts = [len(model.members("shots")) for model in models]
    best = int(np.argmax(counts))
    others = ", ".join(str(number) for i, number in enumerate(counts) if i != best)
    note = (
        "OpenSfM: the reconstruction with the most photos is used; reconstructions "
        f"left out have {others}"
    )
    return models[best], [note] if others else []


def _place(chosen: Fields) -> OnEarth | None:
    """Return the position on Earth of the reconstruction; None if it has no GPS reference.

    Coordinates of the reconstruction are metres east, north and up of this reference.
    """
    if "reference_lla" not in chosen:
        return None
    origin = origin_of(chosen.inner("reference_lla"))
    if (origin.latitude, origin.longitude) == (0.0, 0.0):
        return None
    shots = [shot for shot in chosen.members("shots").values() if "gps_position" in shot]
    off = [_center(shot) - shot.numbers("gps_position", 3) for shot in shots]
    # Compare only x and y, because OpenSfM ignores the altitudes of photos by default.
    level = np.array(off).reshape(-1, 3)[:, :2]
    rms = {"rms_horizontal": float(np.sqrt((level**2).sum(axis=1).mean()))} if off else {}
    return OnEarth(origin, SAME, f"reference_lla of {chosen.file.name}", rms)


def _camera(fields: Fields) -> Calibration:
    """Return the calibration of a camera, in pixels.

    Raises:
        UserError: A field is missing or wrong, or the camera cannot be undistorted.
    """
    kind = fields.text("projection_type", "perspective")
    if kind not in {
        *("perspective", "simple_radial", "radial", "brown"),
        *("fisheye", "fisheye_opencv"),
    }:
        raise refuse_lens(f"projection type {kind}", fields.where("projection_type"))
    width, height = fields.side("width"), fields.side("height")
    unit = max(width, height)
    single = "focal" in fields
    across = fields.positive("focal" if single else "focal_x") * unit
    down = across if single else fields.positive("focal_y") * unit
    lens = Frame(
        *(width, height, across, down),
        fields.number("c_x", 0.0) * unit + width / 2.0,
        fields.number("c_y", 0.0) * unit + height / 2.0,
    )
    k1, k2, k3, k4 = (fields.number(f"k{i}", 0.0) for i in range(1, 5))
    if kind.startswith("fisheye"):
        return lens.fisheye((k1, k2, k3, k4))
    return lens.brown((k1, k2, k3), (fields.number("p1", 0.0), fields.number("p2", 0.0)))


def _view(
    inside: Inside,
    photos: PhotoNames,
    named: tuple[str, Fields],
    cameras: dict[str, Calibration],
) -> RawView:
    name, shot = named
    camera = shot.text("camera")
    if camera not in cameras:
        shot.wrong("camera", f"a camera of the file, such as {min(cameras, default='(none)')}")
    return raw_view(photos.full(name, inside, shot.here), cameras[camera], _pose(shot))


def _pose(shot: Fields) -> NDArray[np.float64]:
    """Return the pose [4, 4], world to camera."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_by(shot.numbers("rotation", 3))
    pose[:3, 3] = shot.numbers("translation", 3)
    return pose


def _center(shot: Fields) -> NDArray[np.float64]:
    """Return the camera centre [3]."""
    pose = _pose(shot)
    return np.asarray(np.linalg.solve(pose[:3, :3], -pose[:3, 3]))


def rotation_by(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation [3, 3] about a vector [3] by the vector's length in radians."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, _SMALL)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))


def _points(chosen: Fields) -> PointCloud:
    points = list(chosen.members("points").values()) if "points" in chosen else []
    colors = np.rint(_column(points, "color").clip(0.0, _BYTE)).astype(np.uint8)
    return PointCloud(_column(points, "coordinates"), colors, chosen.file.name)


def _column(points: Sequence[Fields], key: str) -> NDArray[np.float64]:
    """Return [P, 3] a field of all points.

    All points are converted together for speed, because there may be millions of points. If this
    fails, the points are converted one by one, so that the error names the wrong field.
    """
    stored = [point.value.get(key) for point in points]
    lists = [value for value in stored if isinstance(value, list) and len(value) == 3]  # noqa: PLR2004
    flat = list(chain.from_iterable(lists))
    if len(lists) == len(stored) and set(map(type, flat)) <= {int, float}:
        with suppress(OverflowError):
            table = np.array(flat, dtype=np.float64).reshape(-1, 3)
            if (np.abs(table) <= FARTHEST).all():
                return table
    return np.array([point.numbers(key, 3) for point in points]).reshape(-1, 3)
