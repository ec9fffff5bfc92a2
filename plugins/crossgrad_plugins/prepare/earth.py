"""GPS positions in a local frame, and the roll of a model about a line of GPS positions."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.prepare.plan import Plan, Position

if TYPE_CHECKING:
    import pycolmap


#: Half a turn around the Earth, in degrees of longitude.
_HALF = 180.0
#: EXIF orientation -> camera axis (x right, y down) that points to the top of the photo.
_TOPS: Final = {3: (0.0, 1.0, 0.0), 4: (0.0, 1.0, 0.0), 5: (-1.0, 0.0, 0.0), 6: (-1.0, 0.0, 0.0),
                7: (1.0, 0.0, 0.0), 8: (1.0, 0.0, 0.0)}  # fmt: skip
_TOP: Final = (0.0, -1.0, 0.0)
_STEPS: Final = 1440
#: Limits for the root mean square sine of the tilt angles of photos that should be level. The first
#: value is the maximum at the best roll angle. The second value is the minimum difference between
#: the best and the worst roll angle; with a smaller difference, the roll is unclear.
_LEVEL, _TELLING = 0.15, 0.3
#: Minimum mean upward component of the photos' top directions, or downward component of their
#: viewing directions.
_UPRIGHT: Final = 0.3


def origin_of(plan: Plan) -> Position | None:
    """Return the median GPS position of the photos, or None if no photo has a position."""
    positions = [photo.position for photo in plan.located if photo.position is not None]
    if not positions:
        return None
    longitudes = [position.longitude for position in positions]
    if max(longitudes) - min(longitudes) > _HALF:
        # The photos are on both sides of the date line.
        longitudes = [longitude % (2 * _HALF) for longitude in longitudes]
    east = median(longitudes)
    return Position(
        latitude=median(position.latitude for position in positions),
        longitude=east - 2 * _HALF if east > _HALF else east,
        altitude=median(position.altitude for position in positions),
    )


def local_positions(plan: Plan) -> dict[str, NDArray[np.float64]]:
    """Return positions [3] by photo name, in metres east, north and up of the origin (WGS 84)."""
    origin = origin_of(plan)
    if origin is None:
        return {}
    names = [photo.name for photo in plan.located]
    places = [photo.position for photo in plan.located if photo.position is not None]
    return dict(zip(names, _to_local(places, origin), strict=True))


def _to_local(positions: Sequence[Position], origin: Position) -> NDArray[np.float64]:
    """Return positions [N, 3] in metres east, north and up of the origin."""
    guard_pycolmap()
    import pycolmap

    angles = np.array(
        [[position.latitude, position.longitude, position.altitude] for position in positions]
    )
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(
        transform.ellipsoid_to_enu(angles, origin.latitude, origin.longitude, origin.altitude)
    )


def top_of(orientation: int) -> NDArray[np.float64]:
    """Return the camera axis [3] that points to the top of the displayed photo."""
    return np.array(_TOPS.get(orientation, _TOP))


def levelled(
    model: "pycolmap.Reconstruction",
    similarity: "pycolmap.Sim3d",
    line: tuple[NDArray[np.float64], NDArray[np.float64]],
    tops: Mapping[str, NDArray[np.float64]],
) -> "pycolmap.Sim3d | None":
    """Return the similarity rolled about a line so that photos are level; None if unclear.

    Args:
        model: The model.
        similarity: From the model to metres east, north and up; everything except its roll is
            correct.
        line: A point [3] and the unit direction [3] of the line.
        tops: Name of a photo -> camera axis [3] towards the top of the photo.
    """
    import pycolmap

    point, along = line
    turn = similarity.rotation.matrix()
    images = [model.image(number) for number in model.reg_image_ids()]
    to_world = [turn @ image.cam_from_world().rotation.matrix().T for image in images]
    up = np.array([rows @ tops[image.name] for rows, image in zip(to_world, images, strict=True)])
    ahead = np.array([rows[:, 2] for rows in to_world])
    level = np.cross(up, ahead)
    angles = np.linspace(0.0, 2.0 * np.pi, _STEPS, endpoint=False, dtype=np.float64)
    tilts = np.sqrt((_heights(level, along, angles) ** 2).mean(axis=0))
    if tilts.max() - tilts.min() < _TELLING or tilts.min() > _LEVEL:
        return None
    upright = (_heights(up, along, angles) - _heights(ahead, along, angles)).mean(axis=0)
    # If the model is rolled by half a turn, the photos are level again. In one of these two
    # positions, the photos are upside down.
    best = int(np.argmin(np.where(upright > _UPRIGHT, tilts, np.inf)))
    if upright[best] <= _UPRIGHT or tilts[best] > _LEVEL:
        return None
    roll = pycolmap.Rotation3d(angles[best] * along).matrix()
    matrix = similarity.matrix()
    moved = np.column_stack([roll @ matrix[:, :3], roll @ (matrix[:, 3] - point) + point])
    return pycolmap.Sim3d(moved)


def _heights(
    vectors: NDArray[np.float64], along: NDArray[np.float64], angles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return z [N, A] of vectors [N, 3] rotated about an axis [3] by angles [A]."""
    kept = np.outer(vectors @ along, along)
    across = vectors - kept
    return np.asarray(
        kept[:, 2, None]
        + across[:, 2, None] * np.cos(angles)
        + np.cross(along, vectors)[:, 2, None] * np.sin(angles)
    )
