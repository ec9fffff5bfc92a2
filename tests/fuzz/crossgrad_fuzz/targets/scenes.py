"""Whole scenes through the reader, and the checks on what any reader found."""

import random
import struct
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene import build, calibration, frame
from crossgrad_core.scene import raw as raw_checks
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.frame import camera_centers, make_frame
from crossgrad_core.scene.photos import choose_photos, photo_files
from crossgrad_core.scene.raw import RawScene, RawView, check_distances, check_points, check_views
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, at_offsets, matcher
from crossgrad_fuzz.target import Target
from crossgrad_fuzz.targets.colmap import fields, files
from crossgrad_plugins.readers.colmap import ColmapReader
from crossgrad_plugins.readers.colmap_files import folder as _colmap_folder

_MODEL = "sparse/0"
_SIZE = (24, 16)


def _prepare(folder: Path) -> None:
    """Photos for the poses, one of them turned and with a mask, and some without a pose."""
    (folder / "images" / "sub").mkdir(parents=True)
    (folder / "masks").mkdir()
    for name in ("0000.png", "0001.PNG", "stray.png", "sub/0000.png"):
        Image.new("RGB", _SIZE, (90, 120, 30)).save(folder / "images" / name)
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    Image.new("RGB", _SIZE[::-1]).save(folder / "images" / "0002.png", exif=exif)
    Image.new("L", _SIZE, 255).save(folder / "masks" / "0002.png")


def _seeds() -> Sequence[Case]:
    cases: list[Case] = []
    for text, model in ((False, "PINHOLE"), (False, "OPENCV"), (True, "SIMPLE_RADIAL")):
        found = files(text=text, model=model)
        cases.append({f"{_MODEL}/{name}": content for name, content in found.items()})
    other = {f"sparse/1/{name}": content for name, content in files(text=True).items()}
    plain = {f"sparse/{name}": content for name, content in files(text=True).items()}
    lists = {"train_list.txt": b"0001.png\n0002.png\n", "test_list.txt": b"0000.png\n"}
    second = {name.replace("/1/", "/2/"): content for name, content in other.items()}
    return [
        *(*cases, {**cases[0], **other}, {**plain, **lists}, {**cases[2], **lists}),
        {**cases[1], **second, **lists},
    ]


def _parse(folder: Path) -> None:
    asked = any((folder / "sparse/1").glob("*"))
    reader = ColmapReader(model="sparse/1" if asked else None)
    if not reader.accepts(folder):
        ColmapReader().read(folder, SceneOptions())  # says what is missing
    whole = (folder / "train_list.txt").is_file()
    scene = reader.read(folder, SceneOptions(max_size=None if whole else 20))
    _check_scene(scene.points, len(scene.views))
    assert scene.train
    for view in scene.views:
        camera = view.camera
        assert camera.width > 0
        assert camera.height > 0
        numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32)
        assert np.isfinite(numbers).all()
        assert numbers[:2].min() > 0
        assert camera.world_to_camera.float().isfinite().all()
        assert ((view.seen >= 0) & (view.seen < len(scene.points))).all()
    for note in scene.notes:
        note.encode()
    image = scene.views[0].photo.image()
    assert image.shape[:2] == (scene.views[0].camera.height, scene.views[0].camera.width)


def _check_scene(points: np.ndarray, views: int) -> None:
    assert views > 0
    with np.errstate(over="ignore"):
        assert np.isfinite(points.astype(np.float32)).all()


@cache
def _raw_seeds() -> Sequence[Case]:
    rng = np.random.default_rng(0)
    poses = [np.eye(4) for _ in range(3)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = rng.normal(size=3) + i
    content = b"".join(pose[:3].astype("<f8").tobytes() for pose in poses)
    points = rng.normal(size=(5, 3)).astype("<f8").tobytes()
    camera = struct.pack("<QQ4d", *_SIZE, 20.0, 20.0, 12.0, 8.0)
    names = "a.jpg\nsub/b.jpg\nc.jpg"
    case = {"poses": content, "points": points, "camera": camera, "names": names.encode()}
    distorted = struct.pack("<QQ8d", *_SIZE, 20.0, 20.0, 12.0, 8.0, 0.01, 0.0, 0.0, 0.0)
    far = np.array([1e20, 0.0, 0.0]).tobytes()  # is left out with a note
    return [
        *(case, {**case, "camera": distorted, "points": b""}),
        {**case, "points": points + far},
    ]


def _parse_raw(folder: Path) -> None:
    raw = _raw(folder)
    check_views(raw)
    points, _ = check_points(raw)
    poses = np.stack([view.world_to_camera for view in raw.views])
    made = make_frame(camera_centers(poses), points.xyz)
    points, _ = check_distances(raw, points, made)
    _check_scene(made.points(points.xyz), len(raw.views))
    assert np.isfinite(made.similarity.scale)
    for view in raw.views:
        assert np.isfinite(made.pose(view.world_to_camera)).all()
        rows = points.rows(view.seen)
        assert len(rows) <= len(points.xyz)
        same = view.calibration.resized(view.calibration.width, view.calibration.height)
        assert same == view.calibration
        small = same.resized(12, 8).pinhole.resized(6, 4)
        assert min(small.fx, small.fy) > 0
        assert np.isfinite([small.fx, small.fy, small.cx, small.cy]).all()


def _raw(folder: Path) -> RawScene:
    """The numbers in the files, as many as there are."""

    def content(name: str) -> bytes:
        path = folder / name
        return path.read_bytes() if path.is_file() else b""

    def numbers(name: str, columns: int) -> np.ndarray:
        data = content(name)
        return np.frombuffer(data[: len(data) // (8 * columns) * 8 * columns]).reshape(-1, columns)

    names = content("names").decode("utf-8", errors="surrogateescape").split("\n")
    camera = content("camera").ljust(16, b"\0")
    width, height = struct.unpack_from("<QQ", camera)
    params = tuple(float(value) for value in np.frombuffer(camera[16 : len(camera) // 8 * 8]))
    model = {4: "PINHOLE", 8: "OPENCV", 5: "RADIAL", 3: "SIMPLE_PINHOLE"}.get(len(params), "FOV")
    points = numbers("points", 3)
    poses = np.tile(np.eye(4), (len(numbers("poses", 12)), 1, 1))
    poses[:, :3] = numbers("poses", 12).reshape(-1, 3, 4)
    views = tuple(
        RawView(name, Calibration(model, width, height, params), pose, np.arange(len(points)))
        for name, pose in zip(names, poses, strict=False)
    )
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    return RawScene(Path("scene"), Path("scene/images"), views, points, colors)


def _model_fields(data: bytes) -> list[tuple[int, int, str]]:
    return fields(data) if b"\0" in data[:64] else []


def _eights(data: bytes) -> list[tuple[int, int, str]]:
    return [(at, 8, "f") for at in range(0, len(data) - 7, 8)]


def _names(data: bytes, rng: random.Random) -> bytes:
    """Another name for a photo."""
    name = rng.choice(
        (b"0001.png", b"0002.png", b"../0001.png", b"/0001.png", b".", b"a" * 300, b"\xff.png",
         b"sub/0000.png", b"0001", b"0001.jpg", b"x\x1b[2J.png", b"./0001.png", b"C:\\a.png"),
    )  # fmt: skip
    return data.replace(rng.choice((b"0000.png", b"0001.png", b"0002.png", b"a.jpg")), name, 1)


SCENE = Target(
    name="scene",
    seeds=_seeds,
    parse=_parse,
    prepare=_prepare,
    parser={
        _colmap_folder: ("check_scene_folder", "_check_not_within_sparse", "_similar_folder"),
        build: (),
        photo_files: ("find_mask", "find_mask_folder", "check_masks", "find_photo_folders"),
        choose_photos: ("_find_masks", "_prefer_reduced"),
    },
    words=(
        b"0000.png",
        b"0001.png",
        b"PINHOLE",
        b"OPENCV",
        b"\n\n",
        b"# ",
        b"train",
        b"sub/0000.png",
    ),
    mutators=(at_offsets(_model_fields), matcher(rb"[ \n]([-\d.e]+)", NUMBERS), _names),
)
RAW = Target(
    name="raw-scene",
    seeds=_raw_seeds,
    parse=_parse_raw,
    parser={
        raw_checks: (),
        frame: (),
        calibration: ("Calibration.undistort", "Calibration.fills_frame"),
    },
    words=(b"a.jpg", b"\n", b"../a.jpg", b"/a.jpg", b".", b"\xff", b"a" * 300),
    mutators=(at_offsets(_eights), at_offsets(_eights), _names),
)
TARGETS = (SCENE, RAW)
