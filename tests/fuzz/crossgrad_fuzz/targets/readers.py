"""Scenes of other programs: their files through their readers, from the folder to views."""

import json
import random
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image
from support.formats import FORMATS, Written
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.slots.reader import Reader
from crossgrad_core.scene.photos.photos import FilePhoto
from crossgrad_fuzz.case import Case, load
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Mutator, Target
from crossgrad_plugins.readers import (
    _accepts,
    _cameras,
    _inside,
    _json,
    _raw,
    _transforms,
    _xml,
    blender,
    matrixcity,
    metashape,
    nerfstudio,
    opensfm,
    realitycapture,
    uc_gs,
)

_SIZE = (24, 16)
_PHOTO = ".png"
#: Lenses of the valid inputs; a pinhole in the middle is all that some formats can say.
_PLAIN, _LENSES = ("SIMPLE_PINHOLE",), ("SIMPLE_PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE")
_FIELDS = (
    *(b'"camera_model": "OPENCV_FISHEYE"', b'"k1": 0.1', b'"k3": 0.1', b'"k4": 0.1', b'"w": 24'),
    *(b'"fl_y": 30', b'"camera_angle_y": 1', b'"mask_path": "images/0000.png"', b'"cx": 3'),
    *(b'"distortion_params": [0, 0, 0, 0, 0, 0]', b'"applied_scale": 2', b'"is_fisheye": true'),
    *(b'"train_filenames": ["images/0001.png"]', b'"test_filenames": ["images/0000.png"]'),
    *(b'"rolling_shutter": [0, 0, 0, 1]', b'"fisheye_crop_radius": 5', b'"val_filenames": []'),
)
_WORDS = (
    *(b"..", b"../../", b"/etc/hostname", b"C:\\x", b"0000.png", b"0001.png", b"images/", b"null"),
    *(b"[", b"]", b"{", b"}", b"[]", b"{}", b"NaN", b"Infinity", b"true", b'""', b", ", b": "),
)


def _write(name: str, lens: str, folder: Path) -> Path:
    """The folder of a small scene in a format."""
    split = name == "uc-gs"
    scene = write_tiny_scene(
        folder / "scene", views=3, width=_SIZE[0], height=_SIZE[1], points=4, model=lens,
        centered=True, text=split, folders=("train", "test") if split else ("",),
    )  # fmt: skip
    (folder / "out").mkdir()
    return FORMATS["colmap" if split else name](Written.of(scene), folder / "out")


@cache
def _written(name: str, lens: str) -> Case:
    """The files of a small scene in a format, without its photos."""
    with tempfile.TemporaryDirectory() as place:
        files = load(_write(name, lens, Path(place)))
    return {file: data for file, data in files.items() if not file.endswith(_PHOTO)}


def _changed(case: Case, file: str, change: Callable[[Any], None]) -> Case:
    """A case with a change of the value in a JSON file."""
    value = json.loads(case[file])
    change(value)
    return {**case, file: json.dumps(value).encode()}


def _nerfstudio_seeds() -> Sequence[Case]:
    """All lenses, and the fields that converters write now and then."""
    cases = [_written("nerfstudio", lens) for lens in _LENSES]

    def listed(whole: Any) -> None:
        whole |= {"train_filenames": ["images/0001.png"], "test_filenames": ["images/0000.png"]}
        whole |= {"applied_scale": 2.0, "fisheye_crop_radius": 5}

    def sparse(whole: Any) -> None:
        whole |= {"camera_angle_x": 1.0, "camera_angle_y": 0.7, "val_filenames": []}
        del whole["ply_file_path"], whole["applied_transform"], whole["camera_model"]
        for frame in whole["frames"]:
            for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
                del frame[key]
            frame["file_path"] = frame["file_path"].removesuffix(".png")
            frame["mask_path"] = "keep.png"

    def lens(whole: Any) -> None:
        whole |= {"distortion_params": [0.1, 0, 0, 0, 0, 0], "rolling_shutter": [0, 0, 0, 0]}

    moved = {name.replace("cloud.ply", "sparse_pc.ply"): data for name, data in cases[0].items()}
    # Points by the usual name, in the frame of a file without a transform.
    unturned = _written("blender", _PLAIN[0])["points3d.ply"]
    return [
        *(*cases, _changed(cases[0], "transforms.json", listed)),
        _changed({**moved, "sparse_pc.ply": unturned}, "transforms.json", sparse),
        _changed(cases[0], "transforms.json", lens),
    ]


def _opensfm_seeds() -> Sequence[Case]:
    """All lenses, and a reconstruction that was brought to its place by GPS."""
    cases = [_written("opensfm", lens) for lens in _LENSES]

    def placed(models: Any) -> None:
        place = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
        models[1]["reference_lla"] = place
        for shot in models[1]["shots"].values():
            shot["gps_position"] = [1.0, 2.0, 3.0]

    def nowhere(models: Any) -> None:
        models[1]["reference_lla"] = {"latitude": 0, "longitude": 0, "altitude": 0}

    file = "reconstruction.json"
    return [*cases, _changed(cases[0], file, placed), _changed(cases[0], file, nowhere)]


def _metashape_seeds() -> Sequence[Case]:
    """All lenses, cameras of two components, a chunk without a transform, and one on Earth."""
    cases = [_written("metashape", lens) for lens in _LENSES]
    content = cases[0]["cameras.xml"]
    other = content.replace(b'component_id="0" label="0002', b'component_id="1" label="0002')
    start, end = content.index(b"<components>"), content.index(b"</components>")
    without = content[:start] + content[end + len(b"</components>") :]
    earth = content.replace(b'LOCAL_CS["Local', b'GEOGCS["WGS')
    far = earth.replace(b"<translation>4.0", b"<translation>6378137.0")
    fisheye = cases[2]["cameras.xml"].replace(b"</f>", b"</f><p1>0.1</p1>")
    unposed = re.sub(rb"<transform>[-\d].*?</transform>", b"", content)
    unturned = re.sub(rb"<rotation>.*?</rotation>", b"", content)
    bare = b"<document><chunk/></document>"
    contents = (other, without, earth, far, fisheye, unposed, unturned, bare)
    return [*cases, *({"cameras.xml": each} for each in contents)]


def _prepare(name: str, folder: Path) -> None:
    """The photos of the scene, a mask, and nothing else."""
    with tempfile.TemporaryDirectory() as place:
        out = _write(name, _PLAIN[0], Path(place))
        for photo in out.rglob(f"*{_PHOTO}"):
            to = folder / photo.relative_to(out)
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(photo, to)
    Image.new("L", _SIZE, 255).save(folder / "keep.png")


def _parse(kind: type[Reader], folder: Path) -> None:
    reader = kind()
    reader.accepts(folder)
    scene = reader.read(folder, SceneOptions())
    assert scene.views
    assert scene.train
    assert np.isfinite(scene.points.astype(np.float32)).all()
    for view in scene.views:
        assert view.camera.world_to_camera.float().isfinite().all()
        numbers = [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy]
        assert np.isfinite(np.array(numbers, dtype=np.float32)).all()
        assert isinstance(view.photo, FilePhoto)
        for path in (view.photo.source.path, view.photo.source.mask or folder):
            assert path.resolve().is_relative_to(folder.resolve())
    for note in scene.notes:
        note.encode()


def _renamed(data: bytes, rng: random.Random) -> bytes:
    """Another name for a photo of the lists that folders make."""
    old, new = (
        rng.choice((b"train/", b"test/", b".png")),
        rng.choice((b"eval/", b"test", b"", b"/")),
    )
    return data.replace(old, new, rng.randrange(1, 4))


def _deepen(data: bytes, rng: random.Random) -> bytes:
    """Brackets within each other."""
    at, count = rng.randrange(len(data) + 1), rng.choice((3, 70, 2000))
    left, right = rng.choice(((b"[", b"]"), (b'{"a":', b"}"), (b"<a>", b"</a>")))
    return data[:at] + left * count + right * rng.choice((0, count)) + data[at:]


_NUMBER = matcher(rb"(?<![\w.])(-?\d[-+.\de]*)", NUMBERS)
_TEXT = matcher(rb'"([^"]*)"', (*_WORDS, b"OPENCV", b"frame", b"fisheye", b"spherical", b"1"))
#: Values of all kinds in place of one.
_VALUE = matcher(
    rb": ([^,{}\[\]]+)[,}]", (b"null", b"true", b"[]", b"{}", b'"x"', b"0", b"-1", b"1e999", b"NaN")
)


def _target(
    name: str,
    kind: type[Reader],
    modules: Sequence[ModuleType],
    seeds: Callable[[], Sequence[Case]],
    words: Sequence[bytes] = (),
    mutators: Sequence[Mutator] = (_VALUE,),
) -> Target:
    left_out: Callable[[ModuleType], tuple[str, ...]] = {
        # Links, which no input holds.
        _inside: ("Inside.files",),
        # Files that options name, or of which there are none or several.
        _accepts: ("Kind.one",),
        # Sizes that no input has, and what other formats have.
        _json: ("read_object", "Fields.texts"),
        _xml: ("_parsed", "_Builder.start"),
    }.get
    return Target(
        name=f"{name}-scene",
        seeds=seeds,
        parse=partial(_parse, kind),
        parser={module: left_out(module) or () for module in modules},
        words=(*_WORDS, *words),
        mutators=(_NUMBER, _TEXT, _deepen, *mutators),
        prepare=partial(_prepare, name),
        mebibytes=512,
    )


def _forms(name: str, *lenses: str) -> Callable[[], Sequence[Case]]:
    return lambda: [_written(name, lens) for lens in lenses]


TARGETS = (
    _target("blender", blender.BlenderReader, (blender,), _forms("blender", *_PLAIN), _FIELDS),
    _target(
        *("matrixcity", matrixcity.MatrixCityReader, (matrixcity,)),
        _forms("matrixcity", *_PLAIN),
    ),
    _target(
        *("metashape", metashape.MetashapeReader, (metashape, _accepts, _xml)),
        _metashape_seeds,
        mutators=(),
    ),
    _target(
        *("nerfstudio", nerfstudio.NerfstudioReader),
        (nerfstudio, _transforms, _raw, _cameras, _inside, _cameras),
        *(_nerfstudio_seeds, _FIELDS),
    ),
    _target("uc-gs", uc_gs.UcGsReader, (uc_gs,), _forms("uc-gs", *_PLAIN), (), (_renamed,)),
    _target("opensfm", opensfm.OpenSfmReader, (opensfm, _json), _opensfm_seeds),
    _target(
        *("realitycapture", realitycapture.RealityCaptureReader, (realitycapture, _raw)),
        *(_forms("realitycapture", *_LENSES[:2]), (b",", b"\n", b'"', b"#name"), ()),
    ),
)
