"""The place of a scene on Earth: by GPS of its photos, lists, priors, files, and its own frame."""

import json
import shutil
import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from support.formats import Written, as_metashape, as_opensfm
from support.places import (
    ORIGIN,
    TO_ENU,
    centers_of,
    located,
    place_of,
    tags_of,
    write_gps,
)
from support.scenes import write_tiny_scene

from crossgrad_core.contract.georeference import UNPLACED, Unplaced
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.georeference.ellipsoid import Place, geocentric
from crossgrad_plugins.georeference.frames import Frame3D
from crossgrad_plugins.georeference.on_earth import OnEarth
from crossgrad_plugins.readers.place.files import of_priors
from crossgrad_plugins.readers.place.headers import of_headers

SIZE = {"width": 24, "height": 16, "points": 40}


def read(path, reader="colmap", **options):
    return build("readers", reader, options).read(path, SceneOptions(split="none"))


def earth_of(place):
    """[3] geocentric coordinates."""
    return geocentric(np.array([[place.latitude, place.longitude, place.altitude]]))[0]


def assert_in_place(scene, atol, to_enu=TO_ENU):
    """Cameras are where the tests put them, to so many metres."""
    found = scene.georeference
    assert isinstance(found, OnEarth), found
    for view in scene.views:
        center = scene.similarity.to_input(view.camera.center.numpy()[None])
        here = found.origin.to_enu.inverse.points(found.to_enu.points(center))[0]
        expected = earth_of(place_of(center[0], to_enu))
        np.testing.assert_allclose(here, expected, atol=atol)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Ten photos on a ring, without GPS."""
    path = tmp_path_factory.mktemp("plain") / "scene"
    return write_tiny_scene(path, views=10, suffix=".jpg", **SIZE)


@pytest.fixture
def scene(plain, tmp_path):
    return shutil.copytree(plain, tmp_path / "scene")


@pytest.fixture(scope="module")
def with_gps(plain, tmp_path_factory):
    return located(shutil.copytree(plain, tmp_path_factory.mktemp("gps") / "scene"))


def test_a_scene_without_gps_gets_no_note(plain):
    scene = read(plain)
    assert scene.georeference is UNPLACED
    assert not any("georef" in note for note in scene.notes)


def test_gps_of_the_photos_georeferences_the_scene(with_gps):
    scene = read(with_gps)
    assert_in_place(scene, 1e-4)
    assert max(scene.georeference.residuals.values()) < 1e-4
    assert scene.georeference.to_enu.scale == pytest.approx(TO_ENU.scale, rel=1e-5)
    (note,) = (note for note in scene.notes if "georeferenced" in note)
    assert "GPS of the photos, 10 of 10" in note
    assert "1 unit = 7.5 m; residuals: rms horizontal 0.00 m" in note


def test_georeferencing_does_not_change_training(with_gps, plain):
    ours, theirs = read(with_gps), read(plain)
    assert [v.name for v in ours.views] == [v.name for v in theirs.views]
    np.testing.assert_array_equal(ours.points, theirs.points)
    np.testing.assert_array_equal(ours.similarity.offset, theirs.similarity.offset)


def test_residuals_of_the_georeference_are_the_errors_of_gps(scene):
    residuals = read(located(scene, noise=1.5)).georeference.residuals
    # Seven of thirty numbers go into the similarity.
    assert residuals["rms_horizontal"] == pytest.approx(1.5 * np.sqrt(2), rel=0.5)
    assert residuals["rms_vertical"] == pytest.approx(1.5, rel=0.6)
    assert residuals["max"] >= residuals["rms_horizontal"]


def test_a_photo_with_wrong_gps_is_left_out_and_named(scene):
    located(scene, noise=0.2)
    write_gps(scene / "images" / "0003.jpg", tags_of(Place(52.5, 13.75, 75.0)))
    found = read(scene)
    assert_in_place(found, 2.0)
    assert "left out 1 that disagree (0003.jpg)" in found.georeference.note


def edited(scene, changes):
    """A scene with GPS whose photos by number have other tags."""
    located(scene)
    for number, change in changes.items():
        path = scene / "images" / f"{number:04d}.jpg"
        tags = tags_of(place_of(centers_of(scene)[path.name]))
        write_gps(path, change(tags))
    return scene


def without(*keys):
    return lambda tags: {key: value for key, value in tags.items() if key not in keys}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (without(5, 6), "10 photos without altitude"),
        (without(1, 2), ""),
        (lambda tags: {**tags, 4: (0.0, 0.0, 0.0), 2: (0.0, 0.0, 0.0)}, ""),
        (lambda tags: {**tags, 2: (IFDRational(1, 0), 0.0, 0.0)}, ""),
        (lambda tags: {**tags, 2: (95.0, 0.0, 0.0)}, ""),
        (lambda tags: {**tags, 4: (13.75,)}, ""),
        (lambda tags: tags_of(ORIGIN), "all at the same position"),
    ],
)
def test_a_scene_with_incomplete_gps_is_not_georeferenced(scene, change, why):
    found = read(edited(scene, dict.fromkeys(range(10), change)))
    assert isinstance(found.georeference, Unplaced)
    notes = [note for note in found.notes if note.startswith("not georeferenced")]
    assert len(notes) == bool(why)
    assert all(why in note for note in notes)
    assert why in found.georeference.why


def test_two_photos_with_gps_are_too_few(scene):
    found = read(edited(scene, dict.fromkeys(range(8), without(2))))
    assert "GPS of the photos, 2 of 10: there are 2 of them" in found.georeference.why
    assert_in_place(read(edited(scene, dict.fromkeys(range(7), without(2)))), 1e-3)


def test_a_straight_flight_line_does_not_determine_the_roll(tmp_path):
    guard_pycolmap()
    import pycolmap

    scene = write_tiny_scene(tmp_path / "scene", views=10, suffix=".jpg", **SIZE)
    model = pycolmap.Reconstruction(str(scene / "sparse/0"))
    for i, (_, frame) in enumerate(sorted(model.frames.items())):
        pose = frame.rig_from_world
        center = np.array([0.3 * i, 0.1 * i, 3.0])
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, -(pose.rotation.matrix() @ center))
    model.write_binary(str(scene / "sparse/0"))
    found = read(located(scene, noise=0.5))
    assert "they are on a line" in found.georeference.why
    assert any("not georeferenced" in note for note in found.notes)


def test_positions_below_sea_level_and_in_west_and_south_are_read(tmp_path, plain):
    for place in (Place(-33.9, -70.5, -12.5), Place(78.2, 179.99, 3.0)):
        photo = shutil.copy(plain / "images/0000.jpg", tmp_path / "a.jpg")
        write_gps(photo, tags_of(place))
        (found,) = of_headers({"a": photo}, "photos").places.values()
        np.testing.assert_allclose(earth_of(found), earth_of(place), atol=1e-4)


def test_gps_can_be_read_from_the_original_photos(with_gps, plain):
    scene = read(plain, gps=str(with_gps / "images"))
    assert_in_place(scene, 1e-4)
    with pytest.raises(UserError, match="does not exist"):
        read(plain, gps=str(plain / "nowhere"))
    for path in (plain / "images", plain / "sparse"):
        found = read(plain, gps=str(path))
        assert f"{path}: it contains no position for a photo of the scene" in found.georeference.why
        assert found.notes[-1] == found.georeference.note


def test_reduced_copies_without_gps_do_not_hide_the_gps_of_the_originals(with_gps, plain, tmp_path):
    scene = shutil.copytree(with_gps, tmp_path / "scene")
    (scene / "images_2").mkdir()
    for path in (plain / "images").iterdir():
        with Image.open(path) as image:
            image.resize((12, 8)).save(scene / "images_2" / path.name)
    found = build("readers", "colmap", {}).read(scene, SceneOptions(split="none", max_size=16))
    assert any("images_2" in note for note in found.notes)
    assert_in_place(found, 1e-4)


def geo_list(scene, system, convert, **changes):
    """The lines of a geo.txt; a change is the rest of a photo's line."""
    lines = [system]
    for name, center in centers_of(scene).items():
        numbers = " ".join(repr(float(v)) for v in convert(place_of(center)))
        lines.append(f"{name} {changes.get(name.partition('.')[0], numbers)} 0 0 0")
    return "\n".join(lines) + "\n"


def in_degrees(place):
    return place.longitude, place.latitude, place.altitude


UTM = Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)


def in_utm(place):
    return UTM.transform(place.longitude, place.latitude, place.altitude)


@pytest.mark.parametrize(
    ("system", "convert"),
    [("EPSG:4326", in_degrees), ("EPSG:32633", in_utm), ("WGS84 UTM 33N", in_utm),
     ("+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs", in_utm)],
)  # fmt: skip
def test_a_position_list_georeferences_the_scene(scene, system, convert):
    (scene / "geo.txt").write_text(geo_list(scene, system, convert))
    found = read(scene)
    assert_in_place(found, 1e-5)
    assert "geo.txt, 10 of 10" in found.georeference.note


def test_a_position_list_has_priority_and_an_invalid_list_gives_a_note(scene):
    located(scene, noise=1.0)
    (scene / "geo.txt").write_text(geo_list(scene, "EPSG:4326", in_degrees))
    assert_in_place(read(scene), 1e-5)
    (scene / "geo.txt").write_text("EPSG:4326\n0001.jpg somewhere\n")
    found = read(scene)
    assert "GPS of the photos" in found.georeference.note
    assert any(
        "geo.txt contains no positions: the list of photo positions cannot be read" in n
        for n in found.notes
    )
    with pytest.raises(UserError, match="line 2") as caught:
        read(scene, gps=str(scene / "geo.txt"))
    assert caught.value.where == str(scene / "geo.txt")


@pytest.mark.parametrize(
    "system",
    # Of zone 61 the code would be that of a pole.
    ["EPSG:1", "nonsense", "", "+init=/etc/hostname:1", "WGS84 UTM 61N", "+proj=utm +zone=61"],
)
def test_a_named_list_in_an_unknown_coordinate_system_is_refused(scene, system):
    (scene / "mine.txt").write_text(geo_list(scene, system, in_degrees))
    with pytest.raises(UserError, match="PROJ cannot convert"):
        read(scene, gps=str(scene / "mine.txt"))


def write_priors(scene, path, wgs84=True):
    guard_pycolmap()
    import pycolmap

    database = pycolmap.Database.open(str(path))
    camera = database.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 9, 24, 16))
    systems = pycolmap.PosePriorCoordinateSystem
    for name, center in centers_of(scene).items():
        image = pycolmap.Image()
        image.name, image.camera_id = name, camera
        stored = database.read_image(database.write_image(image))
        place, prior = place_of(center), pycolmap.PosePrior()
        prior.corr_data_id = stored.data_id
        prior.position = np.array([place.latitude, place.longitude, place.altitude])
        prior.coordinate_system = systems.WGS84 if wgs84 else systems.CARTESIAN
        database.write_pose_prior(prior)
    database.close()


def test_priors_in_the_database_georeference_the_scene_and_the_database_is_unchanged(scene):
    path = scene / "database.db"
    write_priors(scene, path)
    before = path.read_bytes()
    found = read(scene)
    assert_in_place(found, 1e-5)
    assert "priors in database.db, 10 of 10" in found.georeference.note
    assert path.read_bytes() == before
    assert sorted(p.name for p in scene.iterdir()) == ["database.db", "images", "sparse"]


def test_pose_priors_without_gps_coordinates_are_ignored(scene):
    write_priors(scene, scene / "database.db", wgs84=False)
    assert read(scene).georeference is UNPLACED


def test_a_file_that_is_not_a_database_is_named(scene, tmp_path):
    (scene / "database.db").write_bytes(b"no database" * 100)
    found = read(scene)
    assert "database.db contains no positions" in found.georeference.why
    (tmp_path / "empty.db").write_bytes(b"")
    assert not of_priors(tmp_path / "empty.db", ["0001.jpg"]).places


def edit(path, *lines):
    with closing(sqlite3.connect(path)) as database:
        for line in lines:
            database.execute(line)
        database.commit()


def test_pose_priors_that_refer_to_each_other_many_times_are_read_once(tmp_path):
    """A join would return 4 * 10^8 rows."""
    path = tmp_path / "database.db"
    blob = struct.pack("<3d", 52.0, 13.0, 30.0).hex()
    count = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 20000)"
    edit(
        path,
        "CREATE TABLE images (image_id INTEGER, name TEXT)",
        "CREATE TABLE pose_priors (image_id INTEGER, position BLOB, coordinate_system INTEGER)",
        f"INSERT INTO images {count} SELECT 1, 'a.jpg' FROM n",
        f"INSERT INTO pose_priors {count} SELECT 1, x'{blob}', 0 FROM n",
    )
    assert of_priors(path, ["a.jpg"]).places == {"a.jpg": Place(52.0, 13.0, 30.0)}
    assert not of_priors(path, ["b.jpg"]).places


def test_a_database_that_expands_to_long_texts_is_refused(tmp_path):
    path = tmp_path / "database.db"
    edit(
        path,
        "CREATE TABLE images (image_id, name AS (hex(zeroblob(200000000))))",
        "CREATE TABLE pose_priors (image_id, position, coordinate_system)",
        "INSERT INTO images VALUES (1)",
    )
    with pytest.raises(UserError, match="COLMAP database cannot be read") as caught:
        of_priors(path, ["a.jpg"])
    assert "too big" in caught.value.found


RESIDUALS = {"photos": 10, "median": 1.25, "max": 4.5, "per_photo": {"0001.jpg": [1, 2, 3]}}
GEOREF = {
    "origin": dict(vars(ORIGIN)),
    "transform": TO_ENU.matrix.tolist(),
    "residuals_m": RESIDUALS,
}


@pytest.mark.parametrize("folder", [".", "sparse/0"])
def test_a_georef_file_next_to_the_model_georeferences_the_scene(scene, folder):
    located(scene, noise=30.0)
    (scene / folder / "georef.json").write_text(json.dumps(GEOREF))
    found = read(scene)
    assert_in_place(found, 1e-6)
    assert dict(found.georeference.residuals) == {"median": 1.25, "max": 4.5}
    assert "residuals: median 1.25 m, max 4.50 m" in found.notes[-1]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"transform": np.diag([1.0, 1.0, 2.0, 1.0]).tolist()}, "transform"),
        ({"transform": np.diag([1.0, -1.0, 1.0, 1.0]).tolist()}, "transform"),
        ({"transform": [[1.0]]}, "transform"),
        ({"origin": {"latitude": 91.0, "longitude": 0.0, "altitude": 0.0}}, "origin.latitude"),
        ({"origin": {"latitude": 1.0, "longitude": 0.0}}, "origin.altitude"),
        ({"origin": None}, "origin"),
        ({"residuals_m": {"max": "far"}}, "residuals_m.max"),
    ],
)
def test_a_broken_georef_file_is_refused_with_its_field(scene, change, field):
    path = scene / "georef.json"
    path.write_text(json.dumps({**GEOREF, **change}))
    with pytest.raises(UserError) as caught:
        read(scene)
    assert caught.value.where == f"{path}: {field}"


def moved_to(scene, convert):
    """A scene whose poses are in a coordinate system, and where they are in the tests' frame."""
    guard_pycolmap()
    import pycolmap

    names = centers_of(scene)
    ends = {name: convert(place_of(center)) for name, center in names.items()}
    here, there = np.array([*names.values()]), np.array([*ends.values()])
    aligned = pycolmap.estimate_sim3d(here, there)
    model = pycolmap.Reconstruction(str(scene / "sparse/0"))
    model.transform(aligned)
    model.write_binary(str(scene / "sparse/0"))
    return names


@pytest.mark.parametrize(
    ("code", "convert", "atol"),
    [("epsg:4978", earth_of, 1e-3), ("epsg:32633", in_utm, 0.05)],
)
def test_poses_in_a_coordinate_system_are_georeferenced_by_its_code(scene, code, convert, atol):
    names = moved_to(scene, convert)
    found = read(scene, crs=code)
    place = found.georeference
    for view in found.views:
        center = found.similarity.to_input(view.camera.center.numpy()[None])
        here = place.origin.to_enu.inverse.points(place.to_enu.points(center))[0]
        # A grid is no plane, and stretches: 0.0004 of 30 m.
        np.testing.assert_allclose(here, earth_of(place_of(names[view.name])), atol=atol)
    assert f"its coordinates in {code.upper()}" in place.note


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"crs": "epsg:4978"}, "outside the area of their coordinate system"),
        ({"crs": "epsg:1"}, "PROJ cannot convert"),
        ({"crs": "epsg:4978", "gps": "."}, "cannot be combined"),
    ],
)
def test_an_impossible_coordinate_system_is_refused(plain, options, what):
    with pytest.raises(UserError, match=what):
        read(plain, **options)


REFERENCE = {"latitude": ORIGIN.latitude, "longitude": ORIGIN.longitude, "altitude": 75.0}
SAME = Frame3D(np.eye(3), np.zeros(3))


@pytest.fixture
def opensfm(scene, tmp_path):
    (tmp_path / "opensfm").mkdir()
    return as_opensfm(Written.of(scene), tmp_path / "opensfm")


def with_reference(path, reference, off=(0.0, 0.0)):
    models = json.loads((path / "reconstruction.json").read_text())
    for shot in models[1]["shots"].values():
        turn, shift = np.array(shot["rotation"]), np.array(shot["translation"])
        center = -Rotation.from_rotvec(turn).as_matrix().T @ shift
        shot["gps_position"] = [*(center[:2] + off), 2.0]
    models[1]["reference_lla"] = reference
    (path / "reconstruction.json").write_text(json.dumps(models))
    return path


def test_the_reference_of_opensfm_georeferences_the_scene(opensfm):
    scene = read(with_reference(opensfm, REFERENCE, off=(3.0, 4.0)), "opensfm")
    assert_in_place(scene, 1e-6, SAME)
    assert scene.georeference.residuals["rms_horizontal"] == pytest.approx(5.0)


def test_a_reference_of_opensfm_without_gps_does_not_georeference_the_scene(opensfm):
    nowhere = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    assert read(with_reference(opensfm, nowhere), "opensfm").georeference is UNPLACED


@pytest.mark.parametrize("frame", ["local", "chunk"])
def test_a_georeferenced_metashape_chunk_georeferences_the_scene(plain, tmp_path, frame):
    path = tmp_path / "metashape"
    path.mkdir()
    as_metashape(Written.of(plain), path)
    (path / "points.ply").unlink()
    file = path / "cameras.xml"
    whole = ORIGIN.to_enu.inverse
    text = file.read_text().replace('LOCAL_CS["Local', 'GEOGCS["WGS')
    for tag, numbers in (("rotation", whole.rotation), ("translation", whole.shift)):
        start, end = text.index(f"<{tag}>"), text.index(f"</{tag}>")
        words = " ".join(map(repr, numbers.ravel().tolist()))
        text = f"{text[:start]}<{tag}>{words}{text[end:]}"
    file.write_text(text.replace("<scale>2.0", "<scale>1.0"))
    reader = build("readers", "metashape", {"frame": frame})
    scene = reader.read(path, SceneOptions(split="none", init="random"))
    found = scene.georeference
    centers = scene.similarity.to_input(np.stack([v.camera.center.numpy() for v in scene.views]))
    here = ORIGIN.to_enu.points(found.origin.to_enu.inverse.points(found.to_enu.points(centers)))
    chunk = read(path, "metashape", frame="chunk") if frame == "local" else scene
    own = chunk.similarity.to_input(np.stack([v.camera.center.numpy() for v in chunk.views]))
    np.testing.assert_allclose(here, own, atol=1e-6)


def test_a_position_list_may_differ_in_suffix_and_case(scene):
    text = geo_list(scene, "EPSG:4326", in_degrees).replace(".jpg", ".JPG")
    (scene / "geo.txt").write_text(text)
    assert "geo.txt, 10 of 10" in read(scene).georeference.note


def test_a_position_list_for_other_photos_is_reported(scene):
    (scene / "geo.txt").write_text("EPSG:4326\nDJI_1.jpg 16.9 52.7 100\n")
    found = read(scene)
    assert "geo.txt: 1 name without a photo, such as DJI_1.jpg" in found.georeference.note


def test_an_exact_name_in_a_position_list_has_priority_over_a_similar_name(scene):
    text = geo_list(scene, "EPSG:4326", in_degrees)
    (scene / "geo.txt").write_text(text + "0001.TIF 11 51 200\n/ 11 51 200\n. 11 51 200\n")
    assert_in_place(read(scene), 1e-5)
    # Of two rows that look like a photo none is meant.
    (scene / "geo.txt").write_text(text.replace("0001.jpg", "0001.TIF") + "0001.PNG 11 51 200\n")
    assert "geo.txt, 9 of 10" in read(scene).georeference.note
