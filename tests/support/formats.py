"""One scene in every format that there is a reader for, written from its COLMAP form."""

import csv
import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import SceneOptions
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.readers.colmap import read_raw

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: World to the world of a nerfstudio file: y and z exchanged, which is exact.
APPLIED = np.array([[1.0, 0, 0, 0.25], [0, 0, 1, -0.5], [0, -1, 0, 2]])
#: Metashape's chunk in the world: a turn by a right angle, a shift and a scale.
CHUNK_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CHUNK_SHIFT, CHUNK_SCALE = np.array([4.0, -2.0, 1.0]), 2.0


@dataclass(frozen=True, eq=False)
class Written:
    """A COLMAP scene: its folder, and what its model holds.

    Attributes:
        folder: With `images/` and `sparse/0`.
        model: The model.
    """

    folder: Path
    model: "pycolmap.Reconstruction"

    @classmethod
    def of(cls, folder: Path) -> "Written":
        """The scene in a folder."""
        guard_pycolmap()
        import pycolmap

        return cls(folder, pycolmap.Reconstruction(str(folder / "sparse" / "0")))

    def shots(self) -> list[tuple[str, "pycolmap.Camera", Array]]:
        """Name, camera and [4, 4] camera to world with OpenCV's axes of each photo, in order.

        Rotations are, to the last bit, those that the reader of COLMAP makes of quaternions.
        """
        exact = {
            v.name: v.world_to_camera
            for v in read_raw(self.folder, "images", None, SceneOptions()).views
        }
        found = []
        for _, image in sorted(self.model.images.items()):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = exact[image.name][:3, :3].T, image.projection_center()
            np.testing.assert_allclose(
                pose[:3, :3].T, image.cam_from_world().rotation.matrix(), atol=1e-15
            )
            found.append((image.name, self.model.cameras[image.camera_id], pose))
        return found

    def points(self) -> tuple[Array, NDArray[np.uint8]]:
        """[P, 3] positions and colours, by id."""
        points = [point for _, point in sorted(self.model.points3D.items())]
        return np.array([p.xyz for p in points]), np.array([p.color for p in points])


def lens_of(camera: "pycolmap.Camera") -> dict[str, float]:
    """fx, fy, cx, cy and the terms of the lens by OpenCV's names."""
    names = [name.strip() for name in camera.params_info.split(",")]
    found = dict(zip(names, (float(value) for value in camera.params), strict=True))
    if "f" in found:
        found["fx"] = found["fy"] = found.pop("f")
    if "k" in found:
        found["k1"] = found.pop("k")
    return found


def _distortion(camera: "pycolmap.Camera") -> dict[str, float]:
    return {
        key: value
        for key, value in lens_of(camera).items()
        if key not in {"fx", "fy", "cx", "cy"} and value
    }


def write_ply(path: Path, points: Array, colors: NDArray[np.uint8]) -> None:
    """Points in float64, so that a reader gets every bit."""
    rows = np.zeros(len(points), [(a, "<f8") for a in "xyz"] + [(c, "u1") for c in "rgb"])
    for i in range(3):
        rows["xyz"[i]], rows["rgb"[i]] = points[:, i], colors[:, i]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue")]
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())


def _photos(scene: Written, out: Path, folder: str = "images") -> None:
    shutil.copytree(scene.folder / "images", out / folder)
    for name in ("train_list.txt", "test_list.txt"):
        if (scene.folder / name).is_file():
            shutil.copy(scene.folder / name, out / name)


def as_nerfstudio(scene: Written, out: Path) -> Path:
    """`transforms.json` with a lens of each frame, masks where there are, and an applied one."""
    _photos(scene, out)
    frames = []
    for name, camera, pose in scene.shots():
        moved = np.vstack([APPLIED, [0.0, 0, 0, 1]]) @ pose @ _OPENGL
        lens = lens_of(camera)
        frames.append(
            {
                "file_path": f"./images/{name}",
                "transform_matrix": moved.tolist(),
                "fl_x": lens["fx"],
                "fl_y": lens["fy"],
                "cx": lens["cx"],
                "cy": lens["cy"],
                "w": camera.width,
                "h": camera.height,
                **_distortion(camera),
            }
        )
    fisheye = any("FISHEYE" in camera.model.name for _, camera, _ in scene.shots())
    points, colors = scene.points()
    write_ply(out / "cloud.ply", points @ APPLIED[:, :3].T + APPLIED[:, 3], colors)
    whole = {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "applied_transform": APPLIED.tolist(),
        "ply_file_path": "cloud.ply",
        "frames": frames,
    }
    (out / "transforms.json").write_text(json.dumps(whole, indent=1))
    return out


def as_blender(scene: Written, out: Path) -> Path:
    """`transforms_train.json`, `transforms_test.json`; each eighth photo of a folder is held out.

    Only of scenes with one focal length and the principal point in the middle.
    """
    shots = scene.shots()
    folders = {name.rpartition("/")[0] for name, _, _ in shots}
    held_out = {
        name
        for folder in folders
        for name in sorted(n for n, _, _ in shots if n.rpartition("/")[0] == folder)[::8]
    }
    for split in ("train", "test"):
        frames = []
        for name, _, pose in shots:
            if (name in held_out) == (split == "test"):
                photo = out / split / name
                photo.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(scene.folder / "images" / name, photo)
                path = f"./{split}/{name.removesuffix('.png')}"
                matrix = (pose @ _OPENGL).tolist()
                frames.append({"file_path": path, "rotation": 0.1, "transform_matrix": matrix})
        camera = shots[0][1]
        angle = 2.0 * math.atan(0.5 * camera.width / lens_of(camera)["fx"])
        whole = {"camera_angle_x": angle, "frames": frames}
        (out / f"transforms_{split}.json").write_text(json.dumps(whole))
    write_ply(out / "points3d.ply", *scene.points())
    return out


def as_matrixcity(scene: Written, out: Path) -> Path:
    """Blocks `FOLDER/block_1/transforms.json` with photos in `rgb/`, one for each photo folder."""
    shots = scene.shots()
    for folder in sorted({name.rpartition("/")[0] for name, _, _ in shots}):
        block = out / folder / "block_1"
        (block / "rgb").mkdir(parents=True)
        frames = []
        for name, _, pose in shots:
            if name.rpartition("/")[0] == folder:
                index = int(Path(name).stem)
                shutil.copy(scene.folder / "images" / name, block / "rgb" / f"{index:04d}.png")
                matrix = pose @ _OPENGL
                matrix[:3, :3] /= 100.0
                frames.append({"frame_index": index, "rot_mat": matrix.tolist()})
        camera = shots[0][1]
        angle = 2.0 * math.atan(0.5 * camera.width / lens_of(camera)["fx"])
        whole = {"camera_angle_x": angle, "frames": frames}
        (block / "transforms.json").write_text(json.dumps(whole))
    write_ply(out / "points.ply", *scene.points())
    return out


def as_opensfm(scene: Written, out: Path) -> Path:
    """`reconstruction.json` beside `images/`, and a smaller reconstruction before it."""
    _photos(scene, out)
    cameras, shots = {}, {}
    for number, camera in scene.model.cameras.items():
        cameras[f"v2 maker {number}"] = _opensfm_camera(camera)
    for name, camera, pose in scene.shots():
        rotation = pose[:3, :3].T
        shots[name] = {
            "rotation": _rotation_vector(rotation).tolist(),
            "translation": (-rotation @ pose[:3, 3]).tolist(),
            "camera": f"v2 maker {camera.camera_id}",
        }
    points = {
        str(i): {"coordinates": xyz.tolist(), "color": [float(c) for c in color]}
        for i, (xyz, color) in enumerate(zip(*scene.points(), strict=True))
    }
    whole = {"cameras": cameras, "shots": shots, "points": points}
    few = {"cameras": cameras, "shots": dict([next(iter(shots.items()))]), "points": {}}
    (out / "reconstruction.json").write_text(json.dumps([few, whole]))
    return out


def _opensfm_camera(camera: "pycolmap.Camera") -> dict[str, Any]:
    lens, unit = lens_of(camera), max(camera.width, camera.height)
    fisheye = "FISHEYE" in camera.model.name
    return {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": lens["fx"] / unit,
        "focal_y": lens["fy"] / unit,
        "c_x": (lens["cx"] - camera.width / 2) / unit,
        "c_y": (lens["cy"] - camera.height / 2) / unit,
        **_distortion(camera),
    }


def _rotation_vector(rotation: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def as_realitycapture(scene: Written, out: Path) -> Path:
    """A CSV of internal and external parameters, beside `images/` and a PLY."""
    from scipy.spatial.transform import Rotation

    _photos(scene, out)
    rows = []
    for name, camera, pose in scene.shots():
        # An independent way to the angles: intrinsic turns about z, x and y.
        turn = Rotation.from_matrix((pose @ _OPENGL)[:3, :3])
        yaw, pitch, roll = turn.as_euler("ZXY", degrees=True)
        lens, unit = lens_of(camera), max(camera.width, camera.height)
        px, py = (lens["cx"] - camera.width / 2) / unit, (lens["cy"] - camera.height / 2) / unit
        terms = _distortion(camera)
        numbers = [*pose[:3, 3], -yaw, pitch, roll, lens["fx"] * 36 / unit, px, py]
        numbers += [terms.get(key, 0.0) for key in ("k1", "k2", "k3", "none", "p1", "p2")]
        rows.append([name, *(repr(float(number)) for number in numbers)])
    header = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    with (out / "cameras.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header.split(","), *rows])
    write_ply(out / "points.ply", *scene.points())
    return out


def as_metashape(scene: Written, out: Path) -> Path:
    """The XML of cameras with a chunk transform, beside `images/` and a PLY in the local frame."""
    _photos(scene, out)
    document = ElementTree.Element("document", version="2.0.0")
    chunk = ElementTree.SubElement(document, "chunk", label="Chunk 1", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors")
    for number, camera in scene.model.cameras.items():
        _metashape_sensor(sensors, number, camera)
    _metashape_transform(ElementTree.SubElement(chunk, "components"))
    cameras = ElementTree.SubElement(chunk, "cameras")
    for i, (name, camera, pose) in enumerate(scene.shots()):
        inner = np.eye(4)
        inner[:3, :3] = CHUNK_TURN.T @ pose[:3, :3]
        inner[:3, 3] = CHUNK_TURN.T @ (pose[:3, 3] - CHUNK_SHIFT) / CHUNK_SCALE
        ids = {"id": str(i), "sensor_id": str(camera.camera_id), "component_id": "0"}
        element = ElementTree.SubElement(cameras, "camera", ids, label=name)
        _text(element, "transform", " ".join(repr(float(value)) for value in inner.ravel()))
    ElementTree.SubElement(cameras, "camera", id="99", sensor_id="1", label="unposed.png")
    _text(chunk, "reference", 'LOCAL_CS["Local Coordinates (m)"]')
    ElementTree.ElementTree(document).write(out / "cameras.xml", encoding="utf-8")
    write_ply(out / "points.ply", *scene.points())
    return out


def _text(parent: ElementTree.Element, tag: str, text: object) -> None:
    ElementTree.SubElement(parent, tag).text = text if isinstance(text, str) else repr(text)


def _metashape_sensor(parent: ElementTree.Element, number: int, camera: "pycolmap.Camera") -> None:
    fisheye = "FISHEYE" in camera.model.name
    kind = "fisheye" if fisheye else "frame"
    sensor = ElementTree.SubElement(parent, "sensor", id=str(number), type=kind)
    size = {"width": str(camera.width), "height": str(camera.height)}
    ElementTree.SubElement(sensor, "resolution", size)
    _text(ElementTree.SubElement(sensor, "calibration", {"class": "initial"}), "f", 1.0)
    calibration = ElementTree.SubElement(sensor, "calibration", {"class": "adjusted"})
    lens = lens_of(camera)
    _text(calibration, "f", lens["fy"])
    _text(calibration, "b1", lens["fx"] - lens["fy"])
    _text(calibration, "cx", lens["cx"] - camera.width / 2)
    _text(calibration, "cy", lens["cy"] - camera.height / 2)
    swapped = {"p1": "p2", "p2": "p1"}
    for key, value in _distortion(camera).items():
        _text(calibration, swapped.get(key, key), value)


def _metashape_transform(parent: ElementTree.Element) -> None:
    component = ElementTree.SubElement(parent, "component", id="0", label="Component 1")
    transform = ElementTree.SubElement(component, "transform")
    _text(transform, "rotation", " ".join(map(repr, CHUNK_TURN.ravel().tolist())))
    _text(transform, "translation", " ".join(map(repr, CHUNK_SHIFT.tolist())))
    _text(transform, "scale", CHUNK_SCALE)


def as_colmap(scene: Written, out: Path) -> Path:
    """The scene itself."""
    shutil.copytree(scene.folder, out, dirs_exist_ok=True)
    return out


#: Name of a reader -> writes its format.
FORMATS: Mapping[str, Callable[[Written, Path], Path]] = {
    "blender": as_blender,
    "colmap": as_colmap,
    "matrixcity": as_matrixcity,
    "metashape": as_metashape,
    "nerfstudio": as_nerfstudio,
    "opensfm": as_opensfm,
    "realitycapture": as_realitycapture,
}


def write_formats(colmap: Path, out: Path) -> dict[str, Path]:
    """A COLMAP scene in every format: name of the reader -> folder below `out`."""
    scene = Written.of(colmap)
    found = {}
    for name, write in FORMATS.items():
        (out / name).mkdir(parents=True, exist_ok=True)
        found[name] = write(scene, out / name)
    return found
