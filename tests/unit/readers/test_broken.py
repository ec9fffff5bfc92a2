"""Broken and hostile scenes end in one error that names file and field; no name leads outside."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.formats import write_formats, write_ply
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_plugins.readers import _xml

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
def test_files_of_other_content_are_named_in_the_error(reader, content, make):
    path = make(reader)
    (path / FILES[reader]).write_bytes(content)
    refuses(path, reader, FILES[reader])


@pytest.mark.parametrize("reader", JSON)
def test_files_above_a_size_limit_are_not_read(reader, make, monkeypatch):
    path = make(reader)
    monkeypatch.setattr("crossgrad_plugins.readers._json.LARGEST", 50)
    refuses(path, reader, FILES[reader], "more than")


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
def test_names_that_point_outside_the_scene_are_refused(reader, name, make):
    path = make(reader)
    Image.new("RGB", (24, 16)).save(path.parent.parent / "secret.png")
    name_it(reader, path, name)
    refuses(path, reader, "outside the scene folder", FILES[reader])


@pytest.mark.parametrize("name", ["a" * 300, "a/" * 600 + "b", "a\nb", "\0", "\ud800"])
@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path", "train_filenames"])
def test_impossible_file_names_are_refused(key, name, make):
    path = make("nerfstudio")
    where = ("frames", 0, key) if key in {"file_path", "mask_path"} else (key,)
    edit(path, "nerfstudio", put(*where, value=[name] if key.endswith("s") else name))
    refuses(path, "nerfstudio", "a file name is not valid", key)


@pytest.mark.parametrize("reader", [*FILES, "colmap"])
@pytest.mark.parametrize("what", ["photo", "folder"])
def test_photos_may_be_links_and_a_note_names_their_location(reader, what, make):
    path = make(reader)
    before = read(path, reader)
    photo = min(path.rglob("0001.png"))
    moved = photo if what == "photo" else photo.parent
    away = path.parent.parent / "elsewhere"
    number = 1 if what == "photo" else len(list(moved.iterdir()))
    moved.rename(away)
    moved.symlink_to(away)
    scene = read(path, reader)
    assert [view.name for view in scene.views] == [view.name for view in before.views]
    for old, new in zip(before.views, scene.views, strict=True):
        assert torch.equal(old.photo.image(), new.photo.image())
    (note,) = set(scene.notes) - set(before.notes)
    assert f"photos: {number} file" in note and f"such as {path}" in note and str(away) in note


@pytest.mark.parametrize("reader", [*FILES, "colmap"])
@pytest.mark.parametrize("what", ["a text", "a pipe", "a device", "a folder", "nothing", "itself"])
def test_a_photo_path_that_is_not_an_image_file_is_refused_at_once(reader, what, make):
    path = make(reader)
    for photo in path.rglob("*.png"):
        photo.unlink()
        if what == "a pipe":
            os.mkfifo(photo)
        else:
            to = {"a text": "/etc/passwd", "a device": "/dev/zero", "a folder": path}
            photo.symlink_to(to.get(what, photo if what == "itself" else path / "gone"))
    refuses(path, reader, ".png" if what in {"a text", "a pipe", "a device"} else "photo")


@pytest.mark.parametrize("reader", FILES)
@pytest.mark.parametrize("what", ["a pipe", "a device"])
def test_a_pipe_or_device_in_place_of_the_pose_file_is_refused_at_once(reader, what, make):
    path = make(reader)
    file = path / FILES[reader]
    file.unlink()
    if what == "a pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/dev/zero")
    assert not build("readers", reader, {}).accepts(path)
    refuses(path, reader)
    if reader in {"nerfstudio", "opensfm", "metashape", "realitycapture"}:
        refuses(path, reader, FILES[reader], options={"file": FILES[reader]})


def test_every_file_may_be_a_link_into_a_cache(make):
    path = make("nerfstudio")
    before = read(path, "nerfstudio")
    store = path.parent.parent / "blobs"
    store.mkdir()
    for number, file in enumerate(sorted(p for p in path.rglob("*") if p.is_file())):
        file.rename(store / str(number))
        file.symlink_to(store / str(number))
    scene = read(path, "nerfstudio")
    assert np.array_equal(scene.points, before.points)
    assert [v.photo.image().sum() for v in scene.views] == [
        v.photo.image().sum() for v in before.views
    ]


def test_only_photos_may_be_links_to_files_outside_the_scene(make):
    path = make("nerfstudio")
    away = path.parent.parent / "away"
    away.mkdir()
    shutil.move(path / "cloud.ply", away)
    (path / "far").symlink_to(away, target_is_directory=True)
    edit(path, "nerfstudio", put("ply_file_path", value="far/cloud.ply"))
    refuses(path, "nerfstudio", "outside the scene folder", "ply_file_path", away)
    refuses(path, "nerfstudio", "outside the scene", options={"points": "far/cloud.ply"})
    # Within the scene folders may be links.
    (path / "far").unlink()
    away.rename(path / "there")
    (path / "far").symlink_to(path / "there", target_is_directory=True)
    assert len(read(path, "nerfstudio").points) == 20


def test_a_count_of_values_beyond_the_memory_is_refused(make, monkeypatch):
    path = make("nerfstudio")
    monkeypatch.setattr("crossgrad_plugins.readers._json.LARGEST", 1 << 20)
    (path / "transforms.json").write_bytes(b'{"frames": [' + b"[]," * 100_000 + b"0]}")
    refuses(path, "nerfstudio", "in memory", "transforms.json")


@pytest.mark.parametrize("key", ["mask_path", "ply_file_path", "train_filenames"])
def test_every_file_name_in_a_file_must_stay_inside_the_scene(key, make):
    path = make("nerfstudio")
    name = "../../secret.png"
    where = {"mask_path": ("frames", 0, key)}.get(key, (key,))
    edit(path, "nerfstudio", put(*where, value=[name] if key.endswith("s") else name))
    refuses(path, "nerfstudio", "outside the scene folder", key)


@pytest.mark.parametrize(
    ("reader", "option"),
    [
        ("nerfstudio", "file"), ("nerfstudio", "points"), ("blender", "folder"),
        ("blender", "points"), ("matrixcity", "points"), ("opensfm", "images"),
        ("opensfm", "file"), ("realitycapture", "images"), ("realitycapture", "file"),
        ("metashape", "images"), ("metashape", "file"), ("metashape", "points"),
    ],
)  # fmt: skip
def test_options_accept_files_inside_the_scene_only(reader, option, make):
    path = make(reader)
    refuses(path, reader, f"reader.{option}", options={option: "../elsewhere"})


def test_a_name_inside_the_scene_may_contain_parent_folders(make):
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


def test_no_file_outside_the_scene_is_read(make):
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
    def test_hostile_xml_files_are_refused(self, content, word, make):
        path = make("metashape")
        (path / "cameras.xml").write_bytes(content)
        refuses(path, "metashape", "cameras.xml", word, options={"file": "cameras.xml"})

    @pytest.mark.parametrize(
        ("content", "word"),
        [
            (b"<d>" + b"<a/>" * 1_000, "more than 1,000 elements"),
            (b"<d><a " + b" ".join(b'a%d=""' % i for i in range(1_000)) + b"/></d>", "elements"),
            (b"<d><a " + b" ".join(b'a%d=""' % i for i in range(20_000)) + b"/></d>", "tag or"),
            (b"<d><!--" + b"-x" * 50_000 + b"--></d>", "tag or comment"),
            (b"<d>" + b"x" * 200_000 + b"</d>", "is larger than"),
        ],
        ids=["elements", "attributes", "wide", "comment", "size"],
    )
    def test_numbers_and_sizes_are_bounded(self, content, word, tmp_path, monkeypatch):
        bounds = {"_MOST": 1_000, "_LONGEST": 1 << 15, "_PIECE": 1 << 12, "LARGEST": 190_000}
        for name, bound in bounds.items():
            monkeypatch.setattr(_xml, name, bound)
        (tmp_path / "a.xml").write_bytes(content)
        with pytest.raises(UserError, match=word):
            _xml.read_xml(tmp_path / "a.xml")

    def test_xml_entities_cannot_include_files(self, make):
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
    def test_a_broken_xml_field_is_named(self, old, new, field, make):
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
    def test_a_broken_table_cell_is_named(self, line, column, cell, field, make):
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
            (b"#name,x,y,alt,heading,pitch,roll,f,f\n", "the column f twice"),
            (b"#name,x,y,alt,heading,pitch,roll,f\na.png,1\n", "8 cells in line 2"),
            (b"\xff\n", "cannot be read"),
            (b"#name,x,y,alt,heading,pitch,roll,f\n", "no image with a pose"),
        ],
    )
    def test_invalid_tables_are_refused(self, content, word, make):
        path = make("realitycapture")
        (path / "cameras.csv").write_bytes(content)
        refuses(path, "realitycapture", word, options={"file": "cameras.csv"})


class TestPoints:
    def test_points_in_another_coordinate_frame_are_refused(self, make):
        path = make("realitycapture")
        far = np.full((20, 3), 1e6) + np.arange(20)[:, None]
        write_ply(path / "points.ply", far, np.zeros((20, 3), np.uint8))
        refuses(
            path, "realitycapture", "no photo shows the SfM points", "points.ply", "--init random"
        )

    def test_a_ply_without_positions_is_refused(self, make):
        path = make("realitycapture")
        header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
        (path / "points.ply").write_text(header)
        refuses(path, "realitycapture", "points.ply", "no y, z")

    def test_an_impossible_vertex_count_is_refused(self, make):
        path = make("nerfstudio")
        content = (path / "cloud.ply").read_bytes()
        (path / "cloud.ply").write_bytes(content.replace(b"vertex 20", b"vertex 2000000000000"))
        refuses(path, "nerfstudio", "cloud.ply", "incomplete")

    @pytest.mark.parametrize(
        ("kind", "values", "stored"),
        [("float", (0.0, 0.5, 1.0), (0, 128, 255)), ("uchar", (0, 7, 255), (0, 7, 255))],
    )
    def test_colors_may_be_fractions_or_whole_numbers(self, kind, values, stored, make):
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
    def test_the_file_of_points_may_be_missing(self, reader, make):
        path = make(reader)
        for file in path.glob("*.ply"):
            file.unlink()
        if reader == "nerfstudio":
            edit(path, reader, put("ply_file_path", value=...))
        assert len(read(path, reader).points) == 0


def test_a_folder_without_read_permission_is_accepted_by_no_reader(make):
    path = make("metashape")
    path.chmod(0)
    try:
        if os.access(path, os.R_OK):
            pytest.skip("the superuser may read everything")
        assert not any(build("readers", name, {}).accepts(path) for name in FILES)
    finally:
        path.chmod(0o755)
