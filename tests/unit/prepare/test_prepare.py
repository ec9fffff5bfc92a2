"""`crossgrad prepare` on a handful of photos, some of them of no use: the scene, the report."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from support.commands import ended

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.run.assemble import read_scene
from crossgrad_plugins.prepare import mapping, matching, undistortion
from crossgrad_plugins.prepare.app import prepared
from crossgrad_plugins.prepare.earth import local_positions, origin_of
from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.photos import find_photos
from crossgrad_plugins.prepare.plan import Plan, Position, Settings
from crossgrad_plugins.prepare.pycolmap_calls import rows_of
from crossgrad_plugins.prepare.report import data_of, summary_lines
from crossgrad_plugins.readers.colmap import ColmapReader

#: Metres of a unit of the bundled scene, for GPS, and a place in the south and the west.
METRES, PLACE = 20.0, (-33.0, -70.0, 500.0)
COUNT = 7
NO_GPS = {"position": None}


def with_gps(source, target, place):
    """A copy of a photo that says where it was taken."""
    exif = Image.Exif()
    latitude, longitude, altitude = place
    exif[0x8825] = {
        1: "S" if latitude < 0 else "N",
        2: sexagesimal(abs(latitude)),
        3: "W" if longitude < 0 else "E",
        4: sexagesimal(abs(longitude)),
        5: b"\0",
        6: altitude,
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as image:
        image.save(target, quality=95, exif=exif)


def sexagesimal(degrees):
    minutes = 60.0 * (degrees % 1.0)
    return float(int(degrees)), float(int(minutes)), 60.0 * (minutes % 1.0)


def true_centers():
    """Name -> centre of the first photos of the bundled scene, in metres of a made-up frame."""
    model = pycolmap.Reconstruction(bundled_scene() / "sparse" / "0")
    images = sorted(model.images.values(), key=lambda image: image.name)[:COUNT]
    # The scene's y is down; z of east, north, up is up.
    turn = np.diag([1.0, -1.0, -1.0])
    return {image.name: METRES * turn @ image.projection_center() for image in images}


@pytest.fixture(scope="module")
def truth():
    return true_centers()


@pytest.fixture(scope="module")
def photos(tmp_path_factory, truth):
    """Seven good photos in two folders, a mask, and five files that are of no use."""
    folder = tmp_path_factory.mktemp("prepare") / "photos"
    places = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).enu_to_ellipsoid(
        np.array(list(truth.values())), *PLACE
    )
    images = bundled_scene() / "images"
    for number, (name, place) in enumerate(zip(truth, places, strict=True)):
        with_gps(images / name, folder / ("kite" if number % 2 else "mast") / name, place)
    first = folder / "mast" / next(iter(truth))
    mask = np.full((298, 400), 255, np.uint8)
    mask[:100] = 0
    (folder / "masks" / "mast").mkdir(parents=True)
    Image.fromarray(mask).save(folder / "masks" / "mast" / f"{first.name}.png")
    shutil.copy(first, folder / "mast" / "z.jpg")
    (folder / "kite" / "cut.jpg").write_bytes(first.read_bytes()[:9000])
    (folder / "phone.HEIC").write_bytes(b"heic")
    Image.new("RGB", (20, 20)).save(folder / "kite" / "icon.png")
    noise = np.random.default_rng(0).integers(0, 8, (298, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(folder / "kite" / "night.png")
    (folder / "notes.txt").write_text("no photo")
    return folder


@pytest.fixture(scope="module")
def scene(photos):
    return photos.with_name("photos-scene")


@pytest.fixture(scope="module")
def report(photos, scene):
    return prepared(photos, scene, Settings())


def content(folder):
    """Path -> bytes of all files of a scene but those in use."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path): path.read_bytes() for path in paths if path.suffix not in {".db", ".lock"}}


def test_every_good_photo_gets_a_pose(report, scene, truth):
    assert {Path(name).name for name in report.posed} == set(truth)
    found = ColmapReader().read(scene, SceneOptions())
    assert len(found.views) == COUNT
    assert len(found.points) > 100
    assert {view.regime for view in found.views} == {"kite", "mast"}


def test_the_scene_is_placed_by_gps(report, scene, truth):
    """Cameras are at their GPS positions (metres east, north, up) within the remaining noise."""
    georef = json.loads((scene / "georef.json").read_text())
    origin = [georef["origin"][key] for key in ("latitude", "longitude", "altitude")]
    assert origin[0] == pytest.approx(PLACE[0], abs=1e-3)
    assert origin[1] == pytest.approx(PLACE[1], abs=1e-3)
    assert georef["transform"] == np.eye(4).tolist()
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    extent = np.ptp(np.array(list(truth.values())), axis=0).max()
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    found = {Path(i.name).name: i.projection_center() for i in model.images.values()}
    on_earth = transform.enu_to_ellipsoid(np.array([found[name] for name in truth]), *origin)
    there = transform.ellipsoid_to_enu(on_earth, *PLACE)
    off = np.linalg.norm(there - np.array(list(truth.values())), axis=1)
    assert off.max() < 0.02 * extent
    assert georef["residuals_m"]["max"] == pytest.approx(off.max(), abs=0.1)
    assert any("residuals" in line for line in summary_lines(report))


@pytest.mark.parametrize(
    ("longitudes", "middle"), [((-70.0, -70.2, -70.1), -70.1), ((179.8, -179.6, 179.9), 179.9)]
)
def test_the_origin_is_near_the_photos(report, longitudes, middle):
    places = [Position(latitude=-17.0, longitude=each, altitude=5.0) for each in longitudes]
    photos = [
        photo.model_copy(update={"position": place})
        for photo, place in zip(report.plan.used, places, strict=False)
    ]
    plan = report.plan.model_copy(update={"used": photos})
    assert origin_of(plan).longitude == pytest.approx(middle)
    assert max(np.linalg.norm(at) for at in local_positions(plan).values()) < 1e5


def test_unusable_photos_are_listed_with_the_reason(report):
    why = {each.name: each.why for each in report.plan.left_out}
    assert set(why) == {"kite/cut.jpg", "phone.HEIC", "kite/icon.png", "mast/z.jpg"}
    assert "the same file as mast/" in why["mast/z.jpg"]
    assert "incomplete" in why["kite/cut.jpg"]
    assert "save as JPEG" in why["phone.HEIC"]
    assert "too small" in why["kite/icon.png"]
    (lost,) = report.lost
    assert lost.name == "kite/night.png"
    assert "dark" in lost.why


def test_the_report_is_written_in_all_formats(report, scene):
    data = json.loads((scene / "report.json").read_text())
    assert data == json.loads(json.dumps(data_of(report)))
    assert (data["used"], data["registered"]) == (COUNT + 1, COUNT)
    assert {row["folder"] for row in data["folders"]} == {"kite", "mast"}
    (across,) = (row for row in data["joins"] if row["first"] != row["second"])
    assert across["pairs"] > 0 and across["matches"] >= 15 * across["pairs"]
    page = (scene / "report.md").read_text()
    assert "kite/night.png" in page and "phone.HEIC" in page
    with Image.open(scene / "report.png") as picture:
        assert picture.width > 500


def test_masks_are_undistorted_with_their_photos(report, scene):
    (mask,) = (scene / "masks").rglob("*.png")
    photo = scene / "images" / mask.relative_to(scene / "masks").with_suffix("")
    with Image.open(mask) as kept, Image.open(photo) as image:
        assert kept.size == image.size
        shares = (np.asarray(kept) > 0).mean(axis=1)
    assert shares[:80].max() == 0.0
    assert shares[-100:].min() == 1.0


def test_preparing_a_scene_again_changes_nothing(report, photos, scene):
    before = content(scene)
    again = prepared(photos, scene, Settings())
    assert data_of(again) == data_of(report)
    assert content(scene) == before


def test_hidden_files_of_other_programs_are_kept_and_temporary_files_of_prepare_are_deleted(
    report, photos, scene, tmp_path
):
    (scene / ".git").mkdir()
    (scene / ".git" / "HEAD").write_text("ref")
    (scene / ".cache").symlink_to(tmp_path)
    (scene / "prepare" / "models" / ".DS_Store").write_text("")
    before = content(scene)
    (scene / "prepare" / ".models.tmp").mkdir()
    (scene / ".report.md.12.tmp").write_text("half")
    (scene / "prepare" / ".placed.tmp").symlink_to(tmp_path)
    (scene / "report.json").unlink()
    prepared(photos, scene, Settings())
    assert content(scene).keys() == before.keys()
    assert (scene / ".cache").is_symlink() and tmp_path.is_dir()
    assert not list((scene / "prepare").glob(".*.tmp"))
    shutil.rmtree(scene / ".git")
    (scene / ".cache").unlink()
    (scene / "prepare" / "models" / ".DS_Store").unlink()


@pytest.mark.slow
def test_repeating_the_last_stages_gives_the_same_scene(report, photos, scene):
    """Work that a killed process did not finish is repeated with the same result."""
    before = content(scene)
    (scene / "report.json").unlink()
    shutil.rmtree(scene / "sparse")
    for path in sorted((scene / "images").rglob("*.jpg"))[::2]:
        path.unlink()
    shutil.rmtree(scene / "prepare" / "placed")
    prepared(photos, scene, Settings())
    assert content(scene).keys() == before.keys()
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    assert model.num_reg_images() == COUNT


def test_other_settings_for_a_begun_scene_are_refused(report, photos, scene):
    before = content(scene)
    with pytest.raises(UserError, match="begun with other photos or settings") as caught:
        prepared(photos, scene, Settings(max_size=200))
    assert "max_size was None, now 200" in caught.value.found
    assert content(scene) == before


@pytest.fixture
def copied(report, scene, tmp_path):
    """A copy of the scene."""
    return shutil.copytree(scene, tmp_path / "photos-scene")


def unfinish(scene):
    """Takes back the last stages, and says that the photos were elsewhere before."""
    (scene / "report.json").unlink()
    for folder in ("sparse", "images", "masks"):
        shutil.rmtree(scene / folder)
    plan = json.loads((scene / "prepare" / "plan.json").read_text())
    for each in plan["used"]:
        each["mask"] = each["mask"] and "/gone/mask.png"
    (scene / "prepare" / "plan.json").write_text(json.dumps(plan | {"photos": "/gone"}))


def test_prepare_continues_after_the_photos_were_moved(copied, scene, photos, tmp_path):
    moved = shutil.copytree(photos, tmp_path / "moved")
    unfinish(copied)
    found = prepared(moved, copied, Settings())
    assert found.plan.photos == str(moved)
    names = {path.relative_to(copied) for path in copied.rglob("*.*")}
    assert names >= {path.relative_to(scene) for path in scene.rglob("*.*")} - {Path("run.lock")}


def test_changed_photos_are_refused_with_a_remedy(copied, photos, tmp_path):
    moved = shutil.copytree(photos, tmp_path / "moved")
    unfinish(copied)
    (gone, changed, *_) = sorted((moved / "kite").glob("img*.jpg"))
    gone.unlink()
    with changed.open("ab") as file:
        file.write(b"more")
    before = content(copied)
    with pytest.raises(UserError, match="begun with other photos or settings") as caught:
        prepared(moved, copied, Settings())
    assert f"1 photo gone: kite/{gone.name}; 1 photo changed: " in caught.value.found
    assert content(copied) == before


@pytest.mark.parametrize(
    "lost", ["workshop", "part", "photos", "some photos", "most photos", "all"]
)
def test_a_finished_scene_is_read_without_its_intermediate_files_and_photos(
    copied, photos, lost, tmp_path
):
    place = shutil.copytree(photos, tmp_path / "photos")
    if lost in {"workshop", "all"}:
        shutil.rmtree(copied / "prepare")
    if lost == "part":
        (copied / "prepare" / "features.json").unlink()
    if lost in {"photos", "all"}:
        shutil.rmtree(place)
    if "some" in lost:
        next((place / "kite").glob("img*.jpg")).unlink()
    if "most" in lost:
        shutil.rmtree(place / "mast")
        for path in (place / "kite").glob("img*.jpg"):
            path.unlink()
    (copied / "run.lock").unlink()
    before = content(copied)
    read, _ = read_scene(RunConfig(scene=place, reader={"name": "photos-alone"}), place)
    assert len(read.views) == COUNT
    as_it_is = any("the scene is used unchanged" in note for note in read.notes)
    assert as_it_is == (lost not in {"some photos", "most photos"})
    assert content(copied) == before and not (copied / "run.lock").exists()


def test_new_photos_for_a_finished_scene_are_reported(copied, photos, tmp_path):
    place = shutil.copytree(photos, tmp_path / "photos")
    Image.effect_noise((400, 298), 20).save(place / "kite" / "new.png")
    with pytest.raises(UserError, match="begun with other photos or settings") as caught:
        read_scene(RunConfig(scene=place, reader={"name": "photos-alone"}), place)
    assert caught.value.found == "1 photo new: kite/new.png"


def test_a_finished_scene_without_intermediate_files_is_not_prepared_again(copied, photos, capsys):
    shutil.rmtree(copied / "prepare")
    before = content(copied)
    assert ended("prepare", photos, copied) == 2
    told = capsys.readouterr().err
    assert "the scene is ready" in told and f"crossgrad run {copied}" in told
    assert content(copied) == before


def test_transparent_photos_get_a_mask(report, tmp_path):
    """Masks are undistorted with their photos. A photo without transparent pixels gets no mask."""
    model = pycolmap.Reconstruction(bundled_scene() / "sparse" / "0")
    names = sorted(image.name for image in model.images.values())
    one = next(iter(model.cameras.values()))
    known = report.plan.used[0].model_copy(update={"width": one.width, "height": one.height})
    used = [
        known.model_copy(update={"name": name, "mask": None, "transparent": name == names[0]})
        for name in names
    ]
    alpha = np.full((one.height, one.width), 255, np.uint8)
    alpha[: one.height // 2] = 100
    photo = Image.new("RGB", (one.width, one.height), "green")
    photo.putalpha(Image.fromarray(alpha))
    photo.save(tmp_path / names[0], format="PNG")
    layout = Layout(tmp_path / "scene")
    plan = Plan(photos=str(tmp_path), settings=Settings(), used=used, left_out=())
    undistortion._write_masks(layout, plan, model)
    (mask,) = layout.masks.iterdir()
    assert mask.name == f"{names[0]}.png"
    with Image.open(mask) as image:
        rows = (np.asarray(image) > 0).mean(axis=1)
    assert rows[: len(rows) // 3].max() == 0.0 and rows[-len(rows) // 3 :].mean() > 0.95
    first, *others = report.plan.used
    shown = (first.model_copy(update={"transparent": True}), *others)
    told = summary_lines(replace(report, plan=report.plan.model_copy(update={"used": shown})))
    assert any(line.startswith(f"transparency: 1 of {COUNT + 1} photos") for line in told)
    assert any(line.startswith(f"masks: 1 of {COUNT + 1} photos") for line in told)


def test_run_with_prepare_prepares_the_photos(report, photos, capsys):
    assert ended("run", photos, "--prepare", "--steps", "1", "--dry-run") == 0
    told = capsys.readouterr().out
    assert f"prepare: {COUNT} of {COUNT + 1} photos have a pose" in told
    assert "already has poses" not in told
    read, name = read_scene(RunConfig(scene=photos, reader={"name": "photos-alone"}), photos)
    assert (name, len(read.views)) == ("photos-alone", COUNT)


def test_existing_poses_that_are_not_used_are_reported(copied, tmp_path):
    shutil.rmtree(copied / "prepare")
    place = shutil.copytree(bundled_scene(), tmp_path / "photos")
    read, _ = read_scene(RunConfig(scene=place, reader={"name": "photos-alone"}), place)
    (told,) = (note for note in read.notes if "already has poses" in note)
    assert "reader colmap" in told and "leave --prepare out" in told


def test_a_run_on_unprepared_photos_names_the_command(photos, capsys):
    assert ended("run", photos) == 2
    told = capsys.readouterr().err
    assert "crossgrad prepare PHOTOS SCENE" in told and "--prepare" in told


@pytest.mark.parametrize(
    ("photos_at", "scene_at", "what"),
    [
        ("gone", "scene", "the photo folder does not exist"),
        ("file", "scene", "must be a folder"),
        ("empty", "scene", "contains no photos"),
        ("one", "scene", "too few photos"),
        ("one", "other", "do not belong to a scene"),
        ("one", "one/scene", "inside the photo folder"),
        ("one", "file", "the folder cannot be created"),
    ],
)
def test_bad_input_gives_one_error_and_writes_nothing(tmp_path, capsys, photos_at, scene_at, what):
    for name in ("empty", "one", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    Image.new("RGB", (100, 100)).save(tmp_path / "one" / "a.jpg")
    (tmp_path / "other" / "thesis.tex").write_text("")
    before = sorted(tmp_path.rglob("*"))
    assert ended("prepare", tmp_path / photos_at, tmp_path / scene_at) == 2
    assert what in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("names", "todo"),
    [
        ([], "name the folder that contains the photos"),
        (["a.jpg"], "add photos that overlap"),
        (["a.jpg", "b.HEIC"], "repair, convert or remove these photos"),
    ],
)
def test_too_few_photos_are_refused_with_a_remedy(names, todo, tmp_path, capsys):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in names:
        Image.new("RGB", (100, 100)).save(photos / name, format="JPEG")
    assert ended("prepare", photos, tmp_path / "scene") == 2
    assert todo in capsys.readouterr().err


def test_photos_in_linked_folders_are_found_once(tmp_path):
    """One regime is in a linked folder. Other links form a cycle or lead to known folders."""
    photos, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    source = sorted((bundled_scene() / "images").rglob("*.jpg"))[:4]
    for place, photo in zip((photos / "street", elsewhere, tmp_path / "far"), source, strict=False):
        place.mkdir(parents=True)
        shutil.copy(photo, place)
    for link, there in {
        photos / "aerial": elsewhere,
        photos / "again": photos / "street",
        photos / "back": photos,
        photos / "up": tmp_path,
        elsewhere / "further": tmp_path / "far",
    }.items():
        link.symlink_to(there)
    used, left_out = find_photos(photos, Settings(), lambda *_: None)
    assert [photo.folder for photo in used] == ["aerial", "street"]
    assert left_out == ()


def test_photos_at_the_root_folder_need_an_output_folder(capsys):
    assert ended("run", "/", "--prepare") == 2
    assert "reader.scene=FOLDER" in capsys.readouterr().err


@pytest.mark.parametrize("given", [("--prepare",), ("--reader", "photos-alone")])
def test_prepare_without_photos_is_refused(given, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert ended("run", *given) == 2
    assert "--prepare needs a folder of photos" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_photos_without_matches_give_one_error(tmp_path, capfd):
    """Pycolmap prints no other line."""
    rng = np.random.default_rng(0)
    (tmp_path / "my photos").mkdir()
    for number in range(3):
        noise = rng.integers(0, 256, (160, 200, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "my photos" / f"{number}.png")
    assert ended("prepare", tmp_path / "my photos", tmp_path / "scene") == 2
    told = capfd.readouterr().err
    assert "no photos match well enough" in told
    assert "3 photos; 0 pairs of them match" in told
    assert "sfm.cc" not in told


@pytest.mark.parametrize("option", ["features", "matching", "mapper", "cameras"])
def test_unknown_choices_are_refused(option, tmp_path, capsys):
    assert ended("prepare", tmp_path, tmp_path / "scene", f"--{option}", "magic") == 2
    assert f"--{option}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--lens", "monocle"), "camera model is unknown"),
        (("--lens", "equirectangular"), "cut them into perspective photos"),
        (("--matching", "spatial"), "needs GPS"),
        (("--masks", "gone"), "mask folder does not exist"),
        ((), "no features"),
    ],
)
def test_impossible_prepare_options_are_refused(options, what, tmp_path, capsys):
    for number in range(2):
        photo = tmp_path / "photos" / f"{number}.png"
        photo.parent.mkdir(exist_ok=True)
        Image.new("RGB", (80, 80), (number,) * 3).save(photo)
    assert ended("prepare", tmp_path / "photos", tmp_path / "scene", *options) == 2
    assert what in capsys.readouterr().err


def test_database_rows_are_counted_while_the_database_is_written(tmp_path):
    path = tmp_path / "a b.db"
    assert rows_of(path, "cameras") == 0
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_name(0, "PINHOLE", 100.0, 80, 60)
    for number in range(3):
        assert rows_of(path, "cameras") == number
        database.write_camera(camera)
    database.close()
    assert rows_of(path, "cameras") == 3


@pytest.mark.parametrize(
    ("count", "located", "folders", "way"),
    [
        (60, 60, 1, "exhaustive"),
        (61, 61, 1, "spatial"),
        (61, 50, 1, "exhaustive"),
        (101, 90, 1, "retrieval"),
        (250, 200, 2, "exhaustive"),
        (251, 200, 2, "retrieval"),
        (2000, 2000, 3, "spatial"),
    ],
)
def test_the_matching_method_depends_on_number_gps_and_folders(
    report, count, located, folders, way
):
    one = next(photo for photo in report.plan.used if photo.position is not None)
    used = tuple(
        one.model_copy(update={"folder": str(n % folders)} | ({} if n < located else NO_GPS))
        for n in range(count)
    )
    assert matching.way_of(Plan(photos="", settings=Settings(), used=used, left_out=())) == way


@pytest.mark.parametrize(
    ("count", "folders", "way"),
    [
        (99, 1, "incremental"),
        (100, 1, "global"),
        (999, 2, "incremental"),
        (1000, 2, "global"),
    ],
)
def test_the_mapping_method_depends_on_number_and_folders(report, count, folders, way):
    one = report.plan.used[0]
    used = tuple(one.model_copy(update={"folder": str(n % folders)}) for n in range(count))
    assert mapping.way_of(Plan(photos="", settings=Settings(), used=used, left_out=())) == way
