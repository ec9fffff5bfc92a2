"""Multi-camera systems of Metashape: poses of slave cameras, computed from master cameras.

A slave camera has no transform. Its sensor contains a location and a rotation instead. The location
is the slave's centre in the coordinates of the master, in the units of the chunk (Metashape's name
for a block of photos). The rotation converts the slave's axes into the master's axes. The slave's
transform is therefore (transform of the master) * [rotation | location]. Source: Metashape Expert
Manual, "The slave-sensor transform: composition rule",
https://photogrammetrycommunity.github.io/metashape-expert-manual/workflow/camera-calibration/slave-sensor-transform-recipes/
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.georeference.frames import rotation_of
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._xml import numbers

_IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False)
class Rig:
    """The poses of all cameras of a chunk.

    Attributes:
        offsets: Id of a slave sensor -> [4, 4] transform from slave to master.
        transforms: Id of a camera with a transform -> [4, 4] transform from camera to chunk.
        sensors: Id of a camera -> id of its sensor.
    """

    offsets: Mapping[str, NDArray[np.float64]]
    transforms: Mapping[str, NDArray[np.float64]]
    sensors: Mapping[str, str]

    @classmethod
    def of(cls, chunk: Element, cameras: list[Element], file: Path) -> "Rig":
        """Return the rig of a chunk with these cameras.

        Raises:
            UserError: A transform or an offset does not consist of a rotation and a translation.
        """
        offsets = {
            sensor.get("id", ""): offset
            for i, sensor in enumerate(chunk.iterfind("sensors/sensor"))
            if (offset := _offset(sensor, file, f"sensors.sensor[{i}]")) is not None
        }
        transforms = {
            camera.get("id", ""): _transform(element, file, f"cameras.camera[{i}]")
            for i, camera in enumerate(cameras)
            if (element := camera.find("transform")) is not None
        }
        sensors = {camera.get("id", ""): camera.get("sensor_id", "") for camera in cameras}
        return cls(offsets, transforms, sensors)

    def is_slave(self, camera: Element) -> bool:
        """Return True if a camera's pose is computed from its master."""
        return camera.find("transform") is None and camera.get("master_id") is not None

    def pose(self, camera: Element) -> NDArray[np.float64] | None:
        """Return the pose [4, 4], camera to chunk; None if the transform or offset is missing."""
        if not self.is_slave(camera):
            return self.transforms.get(camera.get("id", ""))
        master = camera.get("master_id", "")
        pose, offset = self.transforms.get(master), self.offsets.get(camera.get("sensor_id", ""))
        if pose is None or offset is None:
            return None
        # The offsets of a rig refer to one of its sensors, which need not be the master's. Convert
        # the offset so that it refers to the master camera.
        of_master = self.offsets.get(self.sensors.get(master, ""), _IDENTITY)
        return np.asarray(pose @ np.linalg.inv(of_master) @ offset)


def _transform(element: Element, file: Path, place: str) -> NDArray[np.float64]:
    matrix = numbers(element, 16, file, f"{place}.transform").reshape(4, 4)
    return _rigid(matrix[:3, :3], matrix[:3, 3], Fields({}, file, place), "transform")


def _offset(sensor: Element, file: Path, place: str) -> NDArray[np.float64] | None:
    """Return the transform [4, 4] from slave to master; None if the sensor has no offset."""
    location, rotation = sensor.find("location"), sensor.find("rotation")
    if sensor.get("master_id") is None or (location is None and rotation is None):
        return None
    shift, turn = np.zeros(3), np.eye(3)
    if location is not None:
        shift = numbers(location, 3, file, f"{place}.location")
    if rotation is not None:
        turn = numbers(rotation, 9, file, f"{place}.rotation").reshape(3, 3)
    return _rigid(turn, shift, Fields({}, file, place), "rotation")


def _rigid(
    turn: NDArray[np.float64], shift: NDArray[np.float64], fields: Fields, key: str
) -> NDArray[np.float64]:
    rotation = rotation_of(turn)
    if rotation is None:
        fields.wrong(
            key, "an orthonormal, right-handed rotation and a translation", str(turn.tolist())
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift
    return pose
