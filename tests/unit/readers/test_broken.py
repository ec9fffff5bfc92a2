"""Broken and hostile scenes end in one error that names file and field; nothing outside is read."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.formats import write_formats, write_ply
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build

PHOTO = "0001.png"
PHOTO_TAG = f'label="{PHOTO}"><transform>'
FILES = {
    "blender": "transforms_train.json",
    "matrixcity": "block_1/transforms.json",
    "metashape": "cameras.xml",
    "nerfstudio": "transforms.json",
    "opensfm": "reconstruction.json",
    "realitycapture": "cameras.csv",
}
JSON = [name for name, file in FILES.items() if file.endswith(".json")]
BOMB = b"""<?xml version="1.0"?><!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>
<document><chunk label="&b;"><cameras/></chunk></document>"""


@pytest.fixture(scope="module")
def masters(tmp_path_factory):
    root = tmp_path_factory.mktemp("masters")
    scene = write_tiny_scene(
        root / "scene", views=3, width=24, height=16, points=20, model="SIMPLE_PINHOLE",
        centered=True,
    )  # fmt: skip
    return write_formats(scene, root)


@pytest.fixture
def make(masters, tmp_path):
    """A copy of a scene that a test may damage."""

    def copy(reader):
        return Path(shutil.copytree(masters[reader], tmp_path / "around" / reader))

    return copy


def read(path, reader, options=None, **reading):
    return build("readers", reader, options or {}).read(path, SceneOptions(**reading))


def refuses(path, reader, *words, options=None, **reading):
    """Reading raises a `UserError` that says all of `words`."""
    with pytest.raises(UserError) as caught:
        read(path, reader, options, **reading)
    message = str(caught.value)
    assert not [word for word in words if str(word) not in message], message
    assert caught.value.todo


def edit(path, reader, change):
    """Changes the value in a JSON file; what `change` returns, if anything, takes its place."""
    file = path / FILES[reader]
    value = json.loads(file.read_text())
    new = change(value)
    file.write_text(json.dumps(value if new is None else new))


def put(*keys, value):
    """Sets a member of a member; removes it where the value is `...`."""

    def change(whole):
        inner = whole
        for key in keys[:-1]:
            inner = inner[key]
        if value is ...:
            del inner[keys[-1]]
        else:
            inner[keys[-1]] = value

    return change


NERF = ("nerfstudio", "frames", 1)
SHOT = ("opensfm", 1, "shots", PHOTO)
CAMERA = ("opensfm", 1, "cameras", "v2 maker 1")
HUGE, NAN = 10**400, float("nan")
FIELDS = [
    ((*NERF, "transform_matrix"), ..., "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix"), [[1, 0, 0, 0]], "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix"), np.zeros((4, 4)).tolist(), "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix", 0, 3), NAN, "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix", 0, 3), HUGE, "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix", 0, 3), "1.0", "frames[1].transform_matrix"),
    ((*NERF, "transform_matrix", 0, 3), True, "frames[1].transform_matrix"),
    ((*NERF, "file_path"), ..., "frames[1].file_path"),
    ((*NERF, "file_path"), 7, "frames[1].file_path"),
    ((*NERF, "fl_x"), "long", "frames[1].fl_x"),
    ((*NERF, "fl_x"), ..., "fl_x"),
    ((*NERF, "w"), 0, "frames[1].w"),
    ((*NERF, "w"), 24.5, "frames[1].w"),
    ((*NERF, "w"), 10**12, "frames[1].w"),
    ((*NERF, "h"), -16, "frames[1].h"),
    ((*NERF, "fl_x"), 0, "frames[1].fl_x"),
    ((*NERF, "k1"), NAN, "frames[1].k1"),
    ((*NERF, "k4"), 0.5, "frames[1].k4"),
    ((*NERF, "distortion_params"), [0, 0], "frames[1].distortion_params"),
    ((*NERF, "mask_path"), "masks/none.png", "frames[1].mask_path"),
    ((*NERF, "rolling_shutter"), [0, 0, 0.01, 0], "frames[1].rolling_shutter"),
    (("nerfstudio", "frames"), 5, "frames"),
    (("nerfstudio", "frames", 1), [], "frames[1]"),
    (("nerfstudio", "camera_model"), "EQUIRECTANGULAR", "camera_model"),
    (("nerfstudio", "applied_transform"), [[1, 2], [3]], "applied_transform"),
    (("nerfstudio", "applied_scale"), -1, "applied_scale"),
    (("nerfstudio", "ply_file_path"), "none.ply", "none.ply"),
    (("nerfstudio", "train_filenames"), [1], "train_filenames"),
    (("blender", "camera_angle_x"), 4.0, "camera_angle_x"),
    (("blender", "camera_angle_x"), ..., "fl_x"),
    (("blender", "frames", 0, "transform_matrix"), ..., "frames[0].transform_matrix"),
    (("matrixcity", "frames", 1, "rot_mat", 0, 0), 5.0, "frames[1].rot_mat"),
    (("matrixcity", "frames", 1, "frame_index"), -1, "frames[1].frame_index"),
    (("matrixcity", "frames", 1, "frame_index"), 0.5, "frames[1].frame_index"),
    ((*SHOT, "rotation"), [1, 2], "shots.0001.png.rotation"),
    ((*SHOT, "translation"), ..., "shots.0001.png.translation"),
    ((*SHOT, "camera"), "other", "shots.0001.png.camera"),
    ((*CAMERA, "projection_type"), "spherical", "cameras.v2 maker 1.projection_type"),
    ((*CAMERA, "width"), ..., "cameras.v2 maker 1.width"),
    ((*CAMERA, "focal_x"), "0.9", "cameras.v2 maker 1.focal_x"),
    ((*CAMERA, "height"), 10**9, "cameras.v2 maker 1.height"),
    ((*CAMERA, "focal_y"), -0.5, "cameras.v2 maker 1.focal_y"),
    ((*CAMERA, "k1"), HUGE, "cameras.v2 maker 1.k1"),
    (("opensfm", 1, "points", "3", "coordinates"), [1], "points.3.coordinates"),
    (("opensfm", 1, "points", "3", "coordinates", 1), "1", "points.3.coordinates"),
    (("opensfm", 1, "points", "3", "coordinates", 1), True, "points.3.coordinates"),
    (("opensfm", 1, "points", "3", "coordinates", 1), NAN, "points.3.coordinates"),
    (("opensfm", 1, "points", "3", "coordinates", 1), HUGE, "points.3.coordinates"),
    (("opensfm", 1, "points", "3", "color"), None, "points.3.color"),
    (("opensfm", 1, "shots"), [], "shots"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "field"), FIELDS, ids=lambda part: str(part)[:40])
def test_a_broken_field_is_named_with_its_file(keys, value, field, make):
    path = make(keys[0])
    edit(path, keys[0], put(*keys[1:], value=value))
    refuses(path, keys[0], FILES[keys[0]] if field != "none.ply" else field, field)


@pytest.mark.parametrize("reader", JSON)
@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff\xfe", b"[" * 100_000, b'{"a":' * 100_000, b"3", b'{"frames": 1e999}', b"[]"],
    ids=["empty", "cut", "no UTF-8", "deep lists", "deep objects", "a number", "infinite", "list"],
)
def test_files_that_are_no_scene_are_named(reader, content, make):
    path = make(reader)
    (path / FILES[reader]).write_bytes(content)
    refuses(path, reader, FILES[reader])


@pytest.mark.parametrize("reader", JSON)
def test_files_beyond_a_size_are_not_read(reader, make, monkeypatch):
    path = make(reader)
    monkeypatch.setattr("crossgrad_plugins.readers._json.LARGEST", 50)
    refuses(path, reader, FILES[reader], "at most")


OUT = ["../../secret.png", "/etc/hostname", "..\\..\\secret.png", "C:\\secret.png", "a/../../../b"]


def name_it(reader, path, name):
    """Gives a photo another name in the file of the poses."""
    if reader in {"nerfstudio", "blender"}:
        edit(path, reader, put("frames", 0, "file_path", value=name))
    elif reader == "opensfm":
        edit(path, reader, lambda whole: whole[1]["shots"].update(
            {name: whole[1]["shots"].pop(PHOTO)}
        ))  # fmt: skip
    else:
        file = path / FILES[reader]
        file.write_text(file.read_text().replace(PHOTO, name))


@pytest.mark.parametrize("reader", [name for name in FILES if name != "matrixcity"])
@pytest.mark.parametrize("name", OUT)
def test_names_that_lead_out_of_the_scene_are_refused(reader, name, make):
    path = make(reader)
    Image.new("RGB", (24, 16)).save(path.parent.parent / "secret.png")
    name_it(reader, path, name)
    refuses(path, reader, "leads out of the scene", FILES[reader])


@pytest.mark.parametrize("name", ["a" * 300, "a/" * 600 + "b", "a\nb", "\0", "\ud800"])
@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path", "train_filenames"])
def test_names_that_no_file_can_have_are_refused(key, name, make):
    path = make("nerfstudio")
    where = ("frames", 0, key) if key in {"file_path", "mask_path"} else (key,)
    edit(path, "nerfstudio", put(*where, value=[name] if key.endswith("s") else name))
    refuses(path, "nerfstudio", "a name that no file can have", key)


@pytest.mark.parametrize("reader", FILES)
def test_links_that_lead_out_of_the_scene_are_refused(reader, make):
    path = make(reader)
    secret = path.parent.parent / "secret.png"
    Image.new("RGB", (24, 16)).save(secret)
    photo = min(path.rglob("0001.png"))
    photo.unlink()
    photo.symlink_to(secret)
    refuses(path, reader, "leads out of the scene", secret)


@pytest.mark.parametrize("reader", FILES)
def test_a_folder_of_photos_elsewhere_is_refused(reader, make):
    path = make(reader)
    folder = min(path.rglob("0001.png")).parent
    folder.rename(path.parent.parent / "elsewhere")
    folder.symlink_to(path.parent.parent / "elsewhere", target_is_directory=True)
    refuses(path, reader, "leads out of the scene", "elsewhere")


def test_a_link_that_is_found_by_another_suffix_is_refused(make):
    path = make("nerfstudio")
    secret = path.parent.parent / "secret.jpg"
    Image.new("RGB", (24, 16)).save(secret)
    (path / "images" / PHOTO).unlink()
    (path / "images" / "0001.jpg").symlink_to(secret)
    refuses(path, "nerfstudio", "leads out of the scene", "0001.jpg")


@pytest.mark.parametrize("key", ["mask_path", "ply_file_path", "train_filenames"])
def test_every_name_in_a_file_is_held_to_the_scene(key, make):
    path = make("nerfstudio")
    name = "../../secret.png"
    where = {"mask_path": ("frames", 0, key)}.get(key, (key,))
    edit(path, "nerfstudio", put(*where, value=[name] if key.endswith("s") else name))
    refuses(path, "nerfstudio", "leads out of the scene", key)


@pytest.mark.parametrize(
    ("reader", "option"),
    [
        ("nerfstudio", "file"), ("nerfstudio", "points"), ("blender", "folder"),
        ("blender", "points"), ("matrixcity", "points"), ("opensfm", "images"),
        ("opensfm", "file"), ("realitycapture", "images"), ("realitycapture", "file"),
        ("metashape", "images"), ("metashape", "file"), ("metashape", "points"),
        ("uc-gs", "images"),
    ],
)  # fmt: skip
def test_options_name_files_of_the_scene_only(reader, option, make):
    path = make("colmap" if reader == "uc-gs" else reader)
    refuses(path, reader, f"reader.{option}", options={option: "../elsewhere"})


def test_a_name_within_the_scene_may_go_up(make):
    path = make("nerfstudio")
    (path / "poses").mkdir()
    whole = json.loads((path / "transforms.json").read_text())
    for frame in whole["frames"]:
        frame["file_path"] = f"../{frame['file_path']}"
    whole["ply_file_path"] = "../cloud.ply"
    (path / "poses" / "moved.json").write_text(json.dumps(whole))
    scene = read(path, "nerfstudio", {"file": "poses/moved.json"})
    assert [view.name for view in scene.views] == ["0000.png", "0001.png", "0002.png"]
    assert len(scene.points) == 20


def test_nothing_beside_the_scene_is_read(make):
    # Smaller copies of photos lie beside their folder, unless that is the scene itself.
    path = make("blender")
    shutil.copytree(path, path.with_name("blender_2"))
    for photo in path.with_name("blender_2").rglob("*.png"):
        Image.new("RGB", (12, 8)).save(photo)
    scene = read(path, "blender", max_size=16)
    assert "12 x 8" not in "\n".join(scene.notes)


class TestXml:
    @pytest.mark.parametrize(
        ("content", "word"),
        [
            (BOMB, "document type"),
            (b"<document>" + b"<a>" * 100_000, "deep"),
            (b"<document><chunk>", "no element found"),
            (b"", "no element found"),
            ('<?xml version="1.0" encoding="utf-16"?><!DOCTYPE d []><d/>'.encode("utf-16"), "type"),
            (b'<?xml version="1.0" encoding="none"?><d/>', "encoding"),
        ],
        ids=["bomb", "deep", "cut", "empty", "UTF-16", "encoding"],
    )
    def test_hostile_files_are_refused(self, content, word, make):
        path = make("metashape")
        (path / "cameras.xml").write_bytes(content)
        refuses(path, "metashape", "cameras.xml", word, options={"file": "cameras.xml"})

    def test_entities_cannot_name_files(self, make):
        path = make("metashape")
        content = (path / "cameras.xml").read_text()
        declared = '<!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/hostname">]>'
        (path / "cameras.xml").write_text(declared + content.replace(PHOTO, "&x;"))
        refuses(path, "metashape", "document type")

    @pytest.mark.parametrize(
        ("old", "new", "field"),
        [
            (PHOTO_TAG, f"{PHOTO_TAG}nan ", "cameras.camera[1].transform"),
            (PHOTO_TAG, f"{PHOTO_TAG}1e999 ", "cameras.camera[1].transform"),
            ('width="24"', 'width="-3"', "sensors.sensor[0].calibration.width"),
            ('width="24"', 'width="99999999999999999999999999"', "calibration.width"),
            ("<f>28", "<f>-28", "sensors.sensor[0].calibration.f"),
            ("<cx>", "<cx>x", "sensors.sensor[0].calibration.cx"),
            ("<f>28", "<k4>0.1</k4><f>28", "sensors.sensor[0].calibration.k4"),
            ("<f>28", "<b2>0.1</b2><f>28", "sensors.sensor[0].calibration.b2"),
            ('type="frame"', 'type="spherical"', "sensors.sensor[0].type"),
            ('sensor_id="1"', 'sensor_id="9"', "sensor_id"),
            ("<scale>2.0", "<scale>0.0", "component.transform.scale"),
            ("<rotation>0.0", "<rotation>7.0", "component.transform.rotation"),
            ("<rotation>0.0", "<rotation>", "component.transform.rotation"),
            ("cameras>", "others>", "cameras"),
        ],
    )
    def test_a_broken_field_is_named(self, old, new, field, make):
        path = make("metashape")
        content = (path / "cameras.xml").read_text()
        changed = content.replace(old, new)
        assert changed != content
        (path / "cameras.xml").write_text(changed)
        refuses(path, "metashape", field)


class TestCsv:
    @pytest.mark.parametrize(
        ("line", "column", "cell", "field"),
        [
            (1, "x", "nan", "line 2.x"),
            (1, "heading", "north", "line 2.heading"),
            (2, "f", "1e999", "line 3.f"),
            (1, "f", "0", "line 2.f"),
            (1, "k4", "0.5", "line 2.k4"),
            (1, "alt", "1_0", "line 2.alt"),
        ],
    )
    def test_a_broken_cell_is_named(self, line, column, cell, field, make):
        path = make("realitycapture")
        rows = [row.split(",") for row in (path / "cameras.csv").read_text().splitlines()]
        rows[line][rows[0].index(column)] = cell
        (path / "cameras.csv").write_text("\n".join(",".join(row) for row in rows))
        refuses(path, "realitycapture", "cameras.csv", field)

    @pytest.mark.parametrize(
        ("content", "word"),
        [
            (b"#name,x,y\n", "a column alt"),
            (b"", "a column #name"),
            (b"#name,x,y,alt,heading,pitch,roll,f,f\n", "two columns f"),
            (b"#name,x,y,alt,heading,pitch,roll,f\na.png,1\n", "8 cells in line 2"),
            (b"\xff\n", "cannot be read"),
            (b"#name,x,y,alt,heading,pitch,roll,f\n", "no posed image"),
        ],
    )
    def test_other_tables_are_refused(self, content, word, make):
        path = make("realitycapture")
        (path / "cameras.csv").write_bytes(content)
        refuses(path, "realitycapture", word, options={"file": "cameras.csv"})


class TestPoints:
    def test_points_in_another_frame_are_refused(self, make):
        path = make("realitycapture")
        far = np.full((20, 3), 1e6) + np.arange(20)[:, None]
        write_ply(path / "points.ply", far, np.zeros((20, 3), np.uint8))
        refuses(path, "realitycapture", "lie in no photo", "points.ply", "--init random")

    def test_a_ply_without_positions_is_refused(self, make):
        path = make("realitycapture")
        header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
        (path / "points.ply").write_text(header)
        refuses(path, "realitycapture", "points.ply", "no y, z")

    def test_a_count_that_cannot_be_true_is_refused(self, make):
        path = make("nerfstudio")
        content = (path / "cloud.ply").read_bytes()
        (path / "cloud.ply").write_bytes(content.replace(b"vertex 20", b"vertex 2000000000000"))
        refuses(path, "nerfstudio", "cloud.ply", "ends too early")

    @pytest.mark.parametrize(
        ("kind", "values", "stored"),
        [("float", (0.0, 0.5, 1.0), (0, 128, 255)), ("uchar", (0, 7, 255), (0, 7, 255))],
    )
    def test_colors_are_fractions_or_whole_numbers(self, kind, values, stored, make):
        path = make("nerfstudio")
        names = "".join(f"property {kind} {color}\n" for color in ("red", "green", "blue"))
        axes = "property float x\nproperty float y\nproperty float z\n"
        center = " ".join(str(v) for v in (0.25, 0.0, 2.0))
        row = f"{center} {' '.join(map(str, values))}\n"
        header = f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}{names}end_header\n"
        (path / "cloud.ply").write_text(header + row)
        scene = read(path, "nerfstudio")
        assert scene.point_colors.tolist() == [list(stored)]

    @pytest.mark.parametrize("reader", ["nerfstudio", "blender", "metashape"])
    def test_points_may_be_missing(self, reader, make):
        path = make(reader)
        for file in path.glob("*.ply"):
            file.unlink()
        if reader == "nerfstudio":
            edit(path, reader, put("ply_file_path", value=...))
        assert len(read(path, reader).points) == 0


def test_a_folder_that_may_not_be_read_is_taken_by_no_reader(make):
    path = make("metashape")
    path.chmod(0)
    try:
        if os.access(path, os.R_OK):
            pytest.skip("the superuser may read everything")
        assert not any(build("readers", name, {}).accepts(path) for name in FILES)
    finally:
        path.chmod(0o755)
