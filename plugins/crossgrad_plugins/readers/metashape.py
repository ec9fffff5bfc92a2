"""Reader of Agisoft Metashape scenes: Metashape's XML of cameras.

Sources of the format: Metashape Professional, user manual, appendix on camera models;
https://agisoft.freshdesk.com/support/solutions/articles/31000158119. In Metashape's model, p1 and
p2 are swapped compared with OpenCV; b1 is fx - fy, and b2 is the skew; the principal point is
measured from the middle of the photo. Poses are given from camera to chunk (a block of photos),
with OpenCV's axes.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.file_names import FileNames
from crossgrad_core.scene.photos.photo_files import PhotoFolder
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.wording import count
from crossgrad_plugins.georeference.ellipsoid import place_at
from crossgrad_plugins.georeference.frames import SAME, Frame3D, rotation_of
from crossgrad_plugins.georeference.on_earth import OnEarth
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._cameras import Frame, from_opencv, refuse_lens, refuse_term
from crossgrad_plugins.readers._equal_labels import Labelled, paired
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._metashape_rig import Rig
from crossgrad_plugins.readers._raw import find_points, raw_scene, raw_view
from crossgrad_plugins.readers._xml import numbers, read_xml
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder
from crossgrad_plugins.readers.place.place import at, by_gps

_TERMS: Final = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
#: The field of rolling shutter compensation, and its values that mean no compensation.
_ROLLING: Final = "rolling_shutter"
_OFF: Final = frozenset({"false", "0", "no", "off", "none", "disabled"})
_GLOBAL: Final = (
    "set its rolling shutter compensation to Disabled (Tools > Camera Calibration), optimize the "
    "cameras, and export them again"
)
#: Coordinate systems for which the transform of the chunk gives geocentric coordinates.
_ON_EARTH: Final = ("GEOGCS", "PROJCS", "GEOCCS", "COMPD_CS")


class MetashapeReader(Reader):
    """Agisoft Metashape's XML of cameras, a folder of photos, and points from a PLY.

    The transform of the chunk is applied to the poses. Geocentric coordinates are converted to a
    local frame at the centre of the cameras: x east, y north, z up, in metres.
    """

    images: str = Field("images", description="folder of the photos within the scene")
    file: str | None = Field(
        None, description="XML file within the scene; by default the XML file that contains a chunk"
    )
    frame: Literal["local", "chunk"] = Field(
        "local",
        description="local: apply the chunk's transform, then convert to east-north-up if it is "
        "georeferenced; chunk: the chunk's own coordinates. A PLY of points must use "
        "the same coordinates",
    )
    points: str | None = Field(
        None, description="PLY file of points within the scene; by default a PLY file in its folder"
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.metashape(path, self.file)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        file = _accepts.METASHAPE.one(inside, self.file)
        images = inside.name(self.images, "reader.images")
        chunk = _chunk(file)
        cameras, notes = _cameras(chunk, file)
        world, where, place = _world(chunk, file, cameras, self.frame)
        sensors = _sensors(chunk, file, {camera.sensor for camera in cameras})
        names, pairs = _names(inside, chunk, cameras, sensors, path / images)
        views = tuple(
            raw_view(
                name, sensors[camera.sensor], from_opencv(camera.rotation, camera.center, world)
            )
            for name, camera in zip(names, cameras, strict=True)
        )
        points = find_points(inside, options, self.points, "reader.points")
        other = "chunk" if self.frame == "local" else "local"
        check_seen(points, views, file, f"try --set reader.frame={other}, or remove the file")
        head = f"Metashape: {count(len(views), 'posed image')} from {file.name}, {points.note}"
        raw = raw_scene(inside, images, views, points, head, *notes, *pairs, *where)
        scene = build_scene(raw, options)
        return by_gps(scene, raw) if place is None else at(scene, place)


@dataclass(frozen=True, eq=False)
class _Camera:
    """A camera with a pose.

    The fields are label, sensor id, group label, component id, pose and XML attributes.
    """

    label: str
    sensor: str
    group: str
    component: str
    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    fields: Fields


def _chunk(file: Path) -> Element:
    chunk = read_xml(file).find("chunk")
    if chunk is None:
        raise _missing(file, "chunk")
    return chunk


def _missing(file: Path, what: str) -> UserError:
    return UserError(
        "the XML file of Metashape cannot be read",
        where=file,
        expected=f"an element {what}",
        found="none",
        todo="align the photos and export the cameras again",
    )


def _cameras(chunk: Element, file: Path) -> tuple[list[_Camera], list[str]]:
    """Return the cameras with poses of the largest component, and notes on omitted cameras."""
    holder = chunk.find("cameras")
    if holder is None:
        raise _missing(file, "cameras")
    elements = list(holder.iter("camera"))
    rig = Rig.of(chunk, elements, file)
    groups = {element: group.get("label", "") for group in holder.iter("group")
              for element in group.iter("camera")}  # fmt: skip
    components = {element.get("id"): element.get("component_id", "") for element in elements}
    posed, slaves = [], 0
    for i, element in enumerate(elements):
        pose = rig.pose(element) if element.get("enabled", "true") != "false" else None
        if pose is None:
            continue
        component = element.get("component_id", components.get(element.get("master_id"), ""))
        fields = Fields(dict(element.attrib), file, f"cameras.camera[{i}]")
        posed.append(_camera(fields, groups.get(element, ""), component, pose))
        slaves += rig.is_slave(element)
    sizes = Counter(camera.component for camera in posed)
    best = max(sizes, key=lambda component: sizes[component], default="")
    kept = [camera for camera in posed if camera.component == best]
    notes = []
    if slaves:
        notes.append(
            f"Metashape: {count(slaves, 'slave camera')} with poses from their masters "
            "and the offsets of their sensors"
        )
    if len(posed) < len(elements):
        notes.append(f"Metashape: {count(len(elements) - len(posed), 'camera')} without a pose")
    if len(kept) < len(posed):
        notes.append(
            f"Metashape: component {best} is used, "
            f"{count(len(posed) - len(kept), 'camera')} of other components left out"
        )
    return kept, notes


def _camera(fields: Fields, group: str, component: str, pose: NDArray[np.float64]) -> _Camera:
    return _Camera(
        label=fields.text("label"),
        sensor=fields.text("sensor_id"),
        group=group,
        component=component,
        rotation=pose[:3, :3],
        center=pose[:3, 3],
        fields=fields,
    )


def _world(
    chunk: Element, file: Path, cameras: list[_Camera], wanted: str
) -> tuple[Frame3D, list[str], OnEarth | None]:
    """Return the transform from chunk to scene, notes on it, and the scene's position on Earth."""
    frame, name = _transform(chunk, file, cameras[0].component if cameras else "")
    if name is None or not cameras:
        return SAME, [], None
    centers = frame.points(np.stack([camera.center for camera in cameras]))
    on_earth = (chunk.findtext("reference") or "").lstrip().startswith(_ON_EARTH)
    origin = place_at(centers.mean(axis=0)) if on_earth else None
    if origin is None:
        if wanted == "chunk":
            return SAME, [], None
        return frame, [f"Metashape: the transform of the {name} is applied"], None
    local, source = origin.to_enu.after(frame), f"the transform of Metashape's {name}"
    if wanted == "chunk":
        return SAME, [], OnEarth(origin, local, source)
    note = f"Metashape: east, north, up in metres around {origin.text}"
    return local, [note], OnEarth(origin, SAME, source)


def _transform(chunk: Element, file: Path, component: str) -> tuple[Frame3D, str | None]:
    """Return the similarity transform of the component, or else of the chunk, and its source.

    Return None if there is no similarity transform.
    """
    places = [(candidate, "component") for candidate in chunk.iterfind("components/component")
              if candidate.get("id", "") == component]  # fmt: skip
    for holder, name in (*places, (chunk, "chunk")):
        element = holder.find("transform")
        if element is not None:
            return _similarity(element, file, f"{name}.transform"), name
    return SAME, None


def _similarity(element: Element, file: Path, place: str) -> Frame3D:
    turn, shift, size = (element.find(tag) for tag in ("rotation", "translation", "scale"))
    matrix = np.eye(3)
    if turn is not None:
        matrix = numbers(turn, 9, file, f"{place}.rotation").reshape(3, 3)
    rotation = rotation_of(matrix)
    fields = Fields({}, file, place)
    if rotation is None:
        fields.wrong("rotation", "an orthonormal, right-handed rotation", str(matrix.tolist()))
    moved = np.zeros(3) if shift is None else numbers(shift, 3, file, f"{place}.translation")
    scale = 1.0 if size is None else float(numbers(size, 1, file, f"{place}.scale")[0])
    if scale <= 0.0:
        fields.wrong("scale", "a number above zero", f"{scale:g}")
    return Frame3D(rotation, moved, scale)


def _sensors(chunk: Element, file: Path, used: set[str]) -> dict[str, Calibration]:
    """Return the calibrations of the sensors that cameras use, by sensor id."""
    return {
        name: _sensor(sensor, file, f"sensors.sensor[{i}]")
        for i, sensor in enumerate(chunk.iterfind("sensors/sensor"))
        if (name := sensor.get("id", "")) in used
    }


def _sensor(element: Element, file: Path, place: str) -> Calibration:
    kind = element.get("type", "frame")
    fields = Fields(dict(element.attrib), file, place)
    if kind not in {"frame", "fisheye"}:
        raise refuse_lens(f"sensor type {kind}", fields.where("type"))
    if _is_rolling(element):
        what = f"a camera with a rolling shutter ({element.get('label') or 'without a label'})"
        raise refuse_lens(what, fields.where("rolling_shutter"), _GLOBAL)
    # In the file, an adjusted calibration follows the initial calibration, so take the last
    # adjusted one.
    calibrations = element.findall("calibration")
    adjusted = [
        calibration for calibration in calibrations if calibration.get("class") == "adjusted"
    ]
    chosen = next(reversed(adjusted or calibrations), None)
    resolution = element.find("resolution")
    if chosen is None or resolution is None:
        fields.wrong("calibration", "a resolution and a calibration with a focal length f")
    size = {key: _parsed(resolution.get(key)) for key in ("width", "height")}
    values = {term.tag: _parsed(term.text) for term in chosen}
    return _lens(Fields({**values, **size}, file, f"{place}.calibration"), kind)


def _is_rolling(element: Element) -> bool:
    """Return True if Metashape compensates the rolling shutter of a sensor."""
    texts = [child.get("value") for child in element.iterfind("property")
             if child.get("name") == _ROLLING]  # fmt: skip
    texts += [child.get("value", child.text) for child in element.iterfind(_ROLLING)]
    return any(word.lower() not in _OFF for text in texts for word in (text or "").split())


def _parsed(text: str | None) -> object:
    try:
        return float(text or "")
    except ValueError:
        return text


def _lens(fields: Fields, kind: str) -> Calibration:
    width, height, focal = fields.side("width"), fields.side("height"), fields.positive("f")
    term = {key: fields.number(key, 0.0) for key in _TERMS}
    lens = Frame(
        *(width, height, focal + term["b1"], focal),
        fields.number("cx", 0.0) + width / 2.0,
        fields.number("cy", 0.0) + height / 2.0,
    )
    missing = ("p3", "p4", "b2", *(("p1", "p2") if kind == "fisheye" else ("k4",)))
    for key in missing:
        if term[key]:
            raise refuse_term(key, term[key], fields.where(key))
    if kind == "fisheye":
        return lens.fisheye((term["k1"], term["k2"], term["k3"], term["k4"]))
    return lens.brown((term["k1"], term["k2"], term["k3"]), (term["p2"], term["p1"]))


def _names(
    inside: Inside,
    chunk: Element,
    cameras: list[_Camera],
    sensors: dict[str, Calibration],
    images: Path,
) -> tuple[list[str], list[str]]:
    """Return the photo of each camera relative to the photo folder, and notes on the matching."""
    labels = {
        sensor.get("id", ""): sensor.get("label", "") for sensor in chunk.iterfind("sensors/sensor")
    }
    photos = FileNames(PhotoFolder(images).names)
    labelled = []
    for camera in cameras:
        if camera.sensor not in sensors:
            camera.fields.wrong("sensor_id", "a sensor of the file")
        lens = sensors[camera.sensor]
        label, size = camera.label, (lens.width, lens.height)
        if not photos.fitting(label):
            label = inside.name(label, camera.fields.where("label"))
        labelled.append(Labelled(label, camera.group, labels[camera.sensor], size))
    return paired(labelled, photos, images)
