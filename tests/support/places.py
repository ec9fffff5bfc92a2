"""Photos with GPS: scenes of the tests somewhere on Earth."""

from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from crossgrad_core.plugin import SceneOptions
from crossgrad_plugins.georeference.ellipsoid import Place, place_at
from crossgrad_plugins.georeference.frames import Frame3D
from crossgrad_plugins.readers.colmap import read_raw

#: East of Berlin, and a scene there: turned, 7.5 m to the unit.
ORIGIN = Place(52.42, 13.75, 75.0)
TO_ENU = Frame3D(
    Rotation.from_euler("zyx", [40.0, 10.0, 170.0], degrees=True).as_matrix(),
    np.array([12.0, -30.0, 5.0]),
    7.5,
)
_STEP = 10**7


def centers_of(scene: Path) -> dict[str, NDArray[np.float64]]:
    """Name -> camera centre of a COLMAP scene, in its coordinates."""
    views = read_raw(scene, "images", None, SceneOptions()).views
    poses = {view.name: view.world_to_camera for view in views}
    return {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in poses.items()}


def place_of(center: NDArray[np.float64], to_enu: Frame3D = TO_ENU) -> Place:
    """Where a point of the scene is on Earth."""
    place = place_at(ORIGIN.to_enu.inverse.points(to_enu.points(center[None]))[0])
    assert place is not None
    return place


def tags_of(place: Place, altitude: bool = True) -> dict[int, object]:
    """The GPS tags of a photo that was taken there, to some micrometres."""
    tags: dict[int, object] = {}
    for first, value, signs in ((1, place.latitude, "NS"), (3, place.longitude, "EW")):
        whole = int(abs(value))
        minutes, rest = divmod((abs(value) - whole) * 60.0, 1.0)
        seconds = Fraction(round(rest * 60.0 * _STEP), _STEP)
        tags[first] = signs[value < 0]
        tags[first + 1] = (float(whole), minutes, float(seconds))
    if altitude:
        tags[5] = b"\x01" if place.altitude < 0 else b"\x00"
        tags[6] = abs(place.altitude)
    return tags


def write_gps(photo: Path, tags: dict[int, object]) -> None:
    """Gives a photo these tags."""
    with Image.open(photo) as image:
        image.load()
        exif = Image.Exif()
        exif[0x8825] = tags
        image.save(photo, exif=exif)


def located(scene: Path, noise: float = 0.0, altitude: bool = True) -> Path:
    """A COLMAP scene with GPS in its photos, each off by normal errors of so many metres."""
    rng = np.random.default_rng(0)
    for name, center in centers_of(scene).items():
        moved = center + TO_ENU.inverse.rotation @ rng.normal(size=3) * noise / TO_ENU.scale
        write_gps(scene / "images" / name, tags_of(place_of(moved), altitude))
    return scene
