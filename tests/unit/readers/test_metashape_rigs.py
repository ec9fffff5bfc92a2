"""Metashape's multi-camera systems, and photos of cameras with equal labels."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import write_formats
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.file_names import FileNames
from crossgrad_plugins.readers._equal_labels import Labelled, paired
from crossgrad_plugins.readers.metashape import MetashapeReader

SIZE = (24, 16)


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    root = tmp_path_factory.mktemp("rigs")
    scene = write_tiny_scene(root / "scene", views=4, width=SIZE[0], height=SIZE[1], points=20)
    return write_formats(scene, root)["metashape"]


@pytest.fixture
def path(master, tmp_path):
    scene = Path(shutil.copytree(master, tmp_path / "scene"))
    (scene / "points.ply").unlink()  # They are not in the chunk's own coordinates.
    return scene


def read(path):
    return MetashapeReader(frame="chunk", points=None).read(path, SceneOptions())


def text_of(matrix):
    return " ".join(f"{value:.17g}" for value in np.ravel(matrix))


def make_rig(path, *, of_master=None, order="master first", own=False):
    """Makes cameras 2 and 3 slaves of 0 and 1, by a sensor whose offset is that of 2 to 0.

    Camera 3 is moved to where the offset puts it. Returns the poses that all cameras should have.
    """
    file = path / "cameras.xml"
    content = file.read_text()
    found = re.findall(r"<camera .*?</camera>", content, re.DOTALL)
    cameras = [each for each in found if "<transform>" in each]
    poses = [
        np.array(re.search(r"<transform>(.*?)<", each)[1].split(), float).reshape(4, 4)
        for each in cameras
    ]
    offset = np.linalg.inv(poses[0]) @ poses[2]
    poses[3] = poses[1] @ offset
    base = np.eye(4) if of_master is None else of_master
    stored = base @ offset
    extra = [
        f"<location>{text_of(stored[:3, 3])}</location>"
        f"<rotation>{text_of(stored[:3, :3])}</rotation>",
        f"<location>{text_of(base[:3, 3])}</location><rotation>{text_of(base[:3, :3])}</rotation>",
    ]
    sensor = re.search(r"<sensor .*?</sensor>", content, re.DOTALL)[0]
    ids = [re.search(r'\bid="(\d+)"', each)[1] for each in cameras]
    sensor_id = re.search(r'\bid="(\w+)"', sensor)[1]
    slave = re.sub(r'\bid="\w+"', 'id="77" master_id="' + sensor_id + '"', sensor, count=1)
    slave = slave.replace("</sensor>", extra[0] + "</sensor>")
    root = sensor
    if of_master is not None:
        root = re.sub(r"<sensor ", '<sensor master_id="77" ', sensor, count=1)
        root = root.replace("</sensor>", extra[1] + "</sensor>")
    content = content.replace(sensor, root + slave)
    for k in (2, 3):
        changed = re.sub(r"<transform>.*?</transform>", "", cameras[k], flags=re.DOTALL)
        if own:
            changed = re.sub(
                r"(<transform>).*?(</transform>)",
                lambda m, k=k: m[1] + text_of(poses[k]) + m[2],
                cameras[k],
                flags=re.DOTALL,
            )
        changed = re.sub(r'sensor_id="\w+"', 'sensor_id="77"', changed)
        changed = changed.replace("<camera ", f'<camera master_id="{ids[k - 2]}" ', 1)
        content = content.replace(cameras[k], changed)
        cameras[k] = changed
    if order == "slaves first":
        for each in cameras:
            content = content.replace(each, "")
        content = re.sub(r"(<cameras[^>]*>)", lambda m: m[1] + "".join(cameras[::-1]), content)
    file.write_text(content)
    return poses


@pytest.mark.parametrize("order", ["master first", "slaves first"])
def test_slave_cameras_are_placed_by_their_master_and_the_offset(order, path):
    poses = make_rig(path, order=order)
    scene = read(path)
    assert [view.name for view in scene.views] == [f"{i:04d}.png" for i in range(4)]
    centers = [view.camera.center.numpy() for view in scene.views]
    expected = np.stack([pose[:3, 3] for pose in poses])
    np.testing.assert_allclose(scene.similarity.to_input(np.stack(centers)), expected, atol=1e-7)
    for view, pose in zip(scene.views, poses, strict=True):
        np.testing.assert_allclose(
            view.camera.world_to_camera[:3, :3].numpy(), pose[:3, :3].T, atol=1e-9
        )
    assert any("2 slave cameras with poses from their masters" in note for note in scene.notes)


def test_offsets_may_refer_to_a_sensor_other_than_the_master_sensor(path):
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()
    base[:3, 3] = [0.5, -0.1, 0.2]
    poses = make_rig(path, of_master=base)
    scene = read(path)
    centers = np.stack([view.camera.center.numpy() for view in scene.views])
    expected = np.stack([pose[:3, 3] for pose in poses])
    np.testing.assert_allclose(scene.similarity.to_input(centers), expected, atol=1e-7)


def test_a_slave_camera_with_a_transform_does_not_use_its_master(path):
    poses = make_rig(path, own=True)
    scene = read(path)
    centers = np.stack([view.camera.center.numpy() for view in scene.views])
    expected = np.stack([pose[:3, 3] for pose in poses])
    np.testing.assert_allclose(scene.similarity.to_input(centers), expected, atol=1e-7)
    assert not any("slave" in note for note in scene.notes)


def test_slave_cameras_without_an_offset_are_left_out(path):
    make_rig(path)
    file = path / "cameras.xml"
    file.write_text(re.sub(r"<(location|rotation)>[^<]*</\1>", "", file.read_text()))
    scene = read(path)
    assert [view.name for view in scene.views] == ["0000.png", "0001.png"]
    assert any("without a pose" in note for note in scene.notes)


def test_an_offset_without_a_valid_rotation_is_refused(path):
    make_rig(path)
    file = path / "cameras.xml"
    bad = "<rotation>1 0 0 0 1 0 0 0 -1</rotation></sensor>"
    file.write_text(re.sub(r"<rotation>[^<]*</rotation></sensor>", bad, file.read_text()))
    with pytest.raises(UserError, match="right-handed"):
        read(path)


def pairs(cameras, names, folder=Path("none")):
    """The photos of cameras (label, group, sensor) among these names."""
    return paired([Labelled(*camera, SIZE) for camera in cameras], FileNames(names), folder)


@pytest.fixture
def sizes(monkeypatch):
    """Sizes of photos by folder; all photos have the size of the sensors."""
    known = {}
    monkeypatch.setattr(
        "crossgrad_plugins.readers._equal_labels._size_of",
        lambda path: known.get(path.parent.name, SIZE),
    )
    return known


TWO = ["cam0/a.png", "cam1/a.png"]


@pytest.mark.parametrize(
    "cameras",
    [
        [("a", "", "cam0"), ("a", "", "cam1")],
        [("a", "Cam0", "x"), ("a", "CAM1", "x")],
        [("cam0/a", "", "x"), ("cam1/a", "", "x")],
        [("cam0/a.png", "", "x"), ("a.png", "", "x")],
        # The sensor of one names a folder, so that the other photo is left for the other camera.
        [("a", "", "cam0"), ("a", "", "other")],
    ],
)
def test_equal_labels_are_resolved_by_folder_group_sensor_or_exclusion(cameras, sizes):
    for order in (1, -1):
        found, notes = pairs(cameras[::order], TWO)
        assert found == TWO[::order]
        assert not notes


def test_equal_labels_are_resolved_by_the_size_of_the_photo(sizes):
    sizes["cam0"] = (99, 99)
    assert pairs([("a", "", "x")], TWO)[0] == ["cam1/a.png"]


@pytest.mark.parametrize("of", ["group", "sensor"])
def test_equal_labels_are_resolved_by_order_as_a_last_resort_with_a_note(of, sizes):
    labels = [(name, owner) for owner in ("first", "second") for name in ("a", "b")]
    cameras = [(name, owner, "x") if of == "group" else (name, "", owner) for name, owner in labels]
    names = [f"{folder}/{name}.png" for folder in ("left", "right") for name in ("a", "b")]
    found, notes = pairs(cameras, names)
    assert found == names
    assert notes == [
        f"photos with equal labels are paired by the order of {of}s and folders: "
        "first left, second right"
    ]


@pytest.mark.parametrize(
    ("cameras", "names", "named"),
    [
        ([("a", "", "x"), ("a", "", "x")], TWO, r"cam0/a\.png, cam1/a\.png"),
        ([("a", "", "x")], TWO, r"cam0/a\.png, cam1/a\.png"),
        ([("a", "", "x"), ("a", "", "y")], [*TWO, "cam2/a.png"], r"cam0/a\.png"),
        ([("a", "", "x"), ("a", "", "y")], ["cam0/a.png"], r"cam0/a\.png"),
    ],
)
def test_an_unresolved_label_gives_one_error_with_the_label(cameras, names, named, sizes):
    with pytest.raises(UserError, match=rf"a \(sensor x\)(?s:.*){named}"):
        pairs(cameras, names)


def test_missing_photos_get_distinct_names(sizes):
    cameras = [("a", "", "cam0"), ("a", "", "cam1"), ("b", "", "cam0")]
    assert pairs(cameras, ["cam0/a.png"])[0] == ["cam0/a.png", "a (camera 2)", "b"]


def test_a_scene_with_equal_labels_in_two_folders_is_read(path):
    images = path / "images"
    for index in range(4):
        target = images / f"cam{index // 2}" / f"DJI_{index % 2}.png"
        target.parent.mkdir(exist_ok=True)
        (images / f"{index:04d}.png").rename(target)
    content = (path / "cameras.xml").read_text()
    for index in range(4):
        group = f'<group id="{index // 2}" label="cam{index // 2}">' if index % 2 == 0 else ""
        found = re.search(rf'<camera [^>]*label="{index:04d}\.png".*?</camera>', content, re.DOTALL)
        changed = found[0].replace(f"{index:04d}.png", f"DJI_{index % 2}")
        content = content.replace(found[0], group + changed + ("</group>" if index % 2 else ""))
    (path / "cameras.xml").write_text(content)
    names = [view.name for view in read(path).views]
    assert names == ["cam0/DJI_0.png", "cam0/DJI_1.png", "cam1/DJI_0.png", "cam1/DJI_1.png"]
