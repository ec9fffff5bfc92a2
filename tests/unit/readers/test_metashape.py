"""Metashape's XML: lenses in Agisoft's terms, frames of the world, labels, and what is left out."""

import re
import shutil

import numpy as np
import pytest
from support.formats import CHUNK_SCALE, CHUNK_SHIFT, CHUNK_TURN, write_formats
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.readers import metashape
from crossgrad_plugins.readers.metashape import MetashapeReader

#: Latitude and longitude in degrees, height in metres.
PLACE = (52.5, 13.4, 80.0)


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    root = tmp_path_factory.mktemp("master")
    scene = write_tiny_scene(root / "scene", views=3, width=24, height=16, points=20)
    return write_formats(scene, root)["metashape"]


@pytest.fixture
def path(master, tmp_path):
    return shutil.copytree(master, tmp_path / "scene")


def edit(path, pattern, new):
    content = (path / "cameras.xml").read_text()
    changed, number = re.subn(pattern, new, content)
    assert number
    (path / "cameras.xml").write_text(changed)


def read(path, **options):
    return MetashapeReader.model_validate(options).read(path, SceneOptions())


def test_lens_parameters_are_read_in_the_agisoft_convention():
    # x' = x + P1 (r^2 + 2 x^2) + 2 P2 x y; u = w / 2 + cx + x' (f + B1).
    terms = {"f": 100.0, "cx": 2.0, "cy": -3.0, "b1": 5.0, "p1": 0.01, "p2": 0.02, "k1": 0.1}
    fields = metashape.Fields({"width": 40.0, "height": 30.0, **terms}, "cameras.xml")
    lens = metashape._lens(fields, "frame")
    guard_pycolmap()
    import pycolmap

    camera = pycolmap.Camera(model=lens.model, width=40, height=30, params=list(lens.params))
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    across = x * (1 + 0.1 * r2) + 0.01 * (r2 + 2 * x * x) + 2 * 0.02 * x * y
    down = y * (1 + 0.1 * r2) + 0.02 * (r2 + 2 * y * y) + 2 * 0.01 * x * y
    pixel = [20 + 2 + across * 105, 15 - 3 + down * 100]
    np.testing.assert_allclose(camera.img_from_cam(np.array([[x, y, 1.0]]))[0], pixel, rtol=1e-12)


def test_the_coordinate_frame_of_the_metashape_chunk_can_be_selected(path):
    (path / "points.ply").unlink()
    reader, options = MetashapeReader(frame="chunk"), SceneOptions(init="random")
    own, world = reader.read(path, options), MetashapeReader().read(path, options)
    placed = own.similarity.to_input(own.centers)
    moved = CHUNK_SCALE * placed @ CHUNK_TURN.T + CHUNK_SHIFT
    np.testing.assert_allclose(moved, world.similarity.to_input(world.centers), atol=1e-7)


def test_points_of_the_other_frame_are_refused_with_the_option(path):
    edit(path, r"<translation>.*?<", "<translation>9e3 0.0 0.0<")
    with pytest.raises(metashape.UserError, match="no photo shows the SfM points") as caught:
        read(path)
    assert "--set reader.frame=chunk" in caught.value.todo


def test_a_georeferenced_chunk_is_converted_to_the_local_frame(path):
    """Move the scene to Berlin by an independent computation. The reader must undo the move."""
    guard_pycolmap()
    import pycolmap

    before = read(path)
    transform = pycolmap.GPSTransform()
    latitude, longitude = np.deg2rad(PLACE[:2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude),
                   np.sin(latitude)])  # fmt: skip
    axes = np.stack([east, np.cross(up, east), up], axis=1)
    origin = transform.ellipsoid_to_ecef(np.array([PLACE]))[0]
    turn, shift = axes @ CHUNK_TURN, axes @ CHUNK_SHIFT + origin
    edit(path, r"<rotation>.*?<", f"<rotation>{' '.join(map(repr, turn.ravel().tolist()))}<")
    edit(path, r"<translation>.*?<", f"<translation>{' '.join(map(repr, shift.tolist()))}<")
    edit(path, r"<reference>.*?<", '<reference>GEOGCS["WGS 84"]<')
    (path / "points.ply").unlink()
    after = MetashapeReader().read(path, SceneOptions(init="random"))
    for ours, theirs in zip(after.views, before.views, strict=True):
        # The vertical turns by one degree in 111 km, so by 1e-6 over the few metres of a scene.
        np.testing.assert_allclose(
            ours.camera.world_to_camera, theirs.camera.world_to_camera, atol=3e-6
        )
    note = next(note for note in after.notes if "east, north, up" in note)
    latitude, longitude = (float(text) for text in re.findall(r"itude ([\d.]+)", note))
    assert abs(latitude - PLACE[0]) < 1e-3
    assert abs(longitude - PLACE[1]) < 1e-3


def test_cameras_without_a_pose_or_of_other_components_are_left_out(path):
    edit(path, r'component_id="0" label="0002', 'component_id="1" label="0002')
    scene = read(path)
    assert [view.name for view in scene.views] == ["0000.png", "0001.png"]
    notes = "\n".join(scene.notes)
    assert "1 camera without a pose" in notes
    assert "component 0 is used, 1 camera of other components left out" in notes


@pytest.mark.parametrize(("old", "new"), [(r'(\d{4})\.png"', r'\1"'), (r'"(\d{4})', r'"gone/\1')])
def test_labels_match_photos_without_suffix_and_in_other_folders(old, new, path):
    before = read(path)
    edit(path, old, new)
    assert [view.name for view in read(path).views] == [view.name for view in before.views]


def test_a_disabled_camera_is_left_out(path):
    edit(path, 'label="0002.png"', 'label="0002.png" enabled="false"')
    assert len(read(path).views) == 2


@pytest.mark.parametrize(
    "told",
    [
        '<property name="rolling_shutter" value="true"/>'
        '<property name="rolling_shutter_flags" value="63"/>',
        '<property name="rolling_shutter" value="1"/>',
        "<rolling_shutter>true</rolling_shutter>",
    ],
)
def test_a_compensated_rolling_shutter_is_refused_with_a_remedy(told, path):
    """The poses belong to one row of each photo. Other rows have other poses."""
    edit(path, r"(<sensor [^>]*>)", rf"\1{told}")
    with pytest.raises(metashape.UserError, match="rolling shutter") as caught:
        read(path)
    assert caught.value.where.endswith("sensors.sensor[0].rolling_shutter")
    assert "compensation to Disabled" in caught.value.todo


@pytest.mark.parametrize(
    "told",
    [
        '<property name="rolling_shutter" value="false"/>'
        '<property name="rolling_shutter_flags" value="63"/>',
        '<property name="rolling_shutter_flags" value="3"/>',
        '<property name="rolling_shutter" value="Disabled"/>',
        "<rolling_shutter/>",
    ],
)
def test_a_rolling_shutter_without_compensation_is_read(told, path):
    before = [view.camera.world_to_camera.tolist() for view in read(path).views]
    edit(path, r"(<sensor [^>]*>)", rf"\1{told}")
    assert [view.camera.world_to_camera.tolist() for view in read(path).views] == before


def test_a_rolling_shutter_of_an_unused_sensor_is_ignored(path):
    other = '<sensor id="77" type="frame"><property name="rolling_shutter" value="true"/></sensor>'
    edit(path, r"</sensors>", f"{other}</sensors>")
    assert len(read(path).views) == 3
