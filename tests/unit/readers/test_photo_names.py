"""Photos under absolute names, and names with other folders, are found in every format."""

import re
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.formats import write_formats
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build

FILES = {
    "blender": "transforms_train.json",
    "colmap": "sparse/0/images.txt",
    "metashape": "cameras.xml",
    "nerfstudio": "transforms.json",
    "opensfm": "reconstruction.json",
    "realitycapture": "cameras.csv",
}
#: A photo as the files name it, in its folder or without.
NAME = re.compile(r"(?<=[ \"\n])(?:\./)?((?:images/|train/)?\d{4})(\.png)?(?=[ \",\n])")


@pytest.fixture(scope="module")
def masters(tmp_path_factory):
    root = tmp_path_factory.mktemp("masters")
    scene = write_tiny_scene(
        root / "scene", views=3, width=24, height=16, points=20, model="SIMPLE_PINHOLE",
        centered=True, text=True,
    )  # fmt: skip
    return {**write_formats(scene, root), "colmap": scene}


@pytest.fixture
def make(masters, tmp_path):
    return lambda reader: Path(shutil.copytree(masters[reader], tmp_path / "around" / reader))


def read(path, reader, **options):
    return build("readers", reader, {}).read(path, SceneOptions(**options))


def rename(path, reader, form):
    """Gives each photo another name in the file of the poses."""
    file = path / FILES[reader]
    text = file.read_text()
    escape = "\\\\" if file.suffix == ".json" else "\\"

    def new(match):
        name = match[1] + (match[2] or "")
        return form(path, name).replace("\\", escape)

    changed = NAME.sub(new, text)
    assert changed != text
    file.write_text(changed)


FORMS = {
    "in the scene": lambda path, name: f"{path.resolve()}/{_below(path, name)}",
    "elsewhere": lambda _, name: f"/home/alice/old/{name}",
    "on Windows": lambda _, name: "C:\\scans\\" + name.replace("/", "\\"),
    "with a folder in front": lambda _, name: f"data/old/{name}",
    "above": lambda _, name: f"../../old/{name}",
}


def _below(path, name):
    folder = "images/" if (path / "images").is_dir() and "/" not in name else ""
    return folder + name


@pytest.mark.sampled(11)
@pytest.mark.parametrize("reader", FILES)
@pytest.mark.parametrize("form", FORMS)
def test_photos_are_found_by_the_end_of_their_path(reader, form, make):
    path = make(reader)
    before = read(path, reader)
    rename(path, reader, FORMS[form])
    after = read(path, reader)
    assert [view.name for view in after.views] == [view.name for view in before.views]
    assert after.train == before.train
    for old, new in zip(before.views, after.views, strict=True):
        assert old.photo.source.path.resolve() == new.photo.source.path.resolve()


def test_some_names_may_have_an_extra_folder_and_a_note_names_them(make):
    path = make("colmap")
    file = path / FILES["colmap"]
    file.write_text(file.read_text().replace(" 0001.png", " images/0001.png"))
    scene = read(path, "colmap")
    assert [view.name for view in scene.views] == ["0000.png", "0001.png", "0002.png"]
    note = "1 posed image found by the end of their path: images/0001.png is 0001.png"
    assert f"photos: {note}" in scene.notes


@pytest.mark.parametrize("name", ["0001.png", "images/0001.png"])
def test_view_lists_may_use_names_with_or_without_the_extra_folder(name, make):
    path = make("colmap")
    rename(path, "colmap", lambda _, photo: f"images/{photo}")
    (path / "test_list.txt").write_text(f"{name}\n")
    scene = read(path, "colmap")
    assert [scene.views[index].name for index in scene.test] == ["0001.png"]


def test_a_split_of_the_reader_uses_the_corrected_names(make):
    path = make("colmap")
    (path / "images" / "test").mkdir()
    (path / "images" / "0001.png").rename(path / "images" / "test" / "0001.png")
    file = path / FILES["colmap"]
    file.write_text(file.read_text().replace(" 0001.png", " images/test/0001.png"))
    scene = read(path, "uc-gs")
    assert [scene.views[index].name for index in scene.test] == ["test/0001.png"]


def _two_folders(path):
    for folder in ("a", "b"):
        (path / "images" / folder).mkdir()
        shutil.copy(path / "images" / "0001.png", path / "images" / folder)
    (path / "images" / "0001.png").unlink()


def test_a_name_that_fits_two_photos_is_left_out_with_a_note(make):
    path = make("colmap")
    _two_folders(path)
    scene = read(path, "colmap")
    assert [view.name for view in scene.views] == ["0000.png", "0002.png"]
    assert "0001.png (a/0001.png or b/0001.png)" in " ".join(scene.notes)


def test_an_absolute_name_that_fits_two_photos_is_an_error(make):
    path = make("colmap")
    _two_folders(path)
    rename(path, "colmap", FORMS["elsewhere"])
    with pytest.raises(
        UserError, match="an image name of the model matches several photos"
    ) as caught:
        read(path, "colmap")
    assert caught.value.found == "/home/alice/old/0001.png, which can be a/0001.png, b/0001.png"


def test_an_absolute_name_does_not_match_reduced_copies_and_masks(make):
    path = make("nerfstudio")
    for folder in ("images_2", "masks"):
        shutil.copytree(path / "images", path / folder)
    rename(path, "nerfstudio", lambda _, name: "D:\\" + name.rpartition("/")[2])
    scene = read(path, "nerfstudio")
    assert {view.photo.source.path.parent for view in scene.views} == {path / "images"}


def test_masks_and_points_with_absolute_names_are_found(make):
    path = make("nerfstudio")
    before = read(path, "nerfstudio")
    (path / "masks").mkdir()
    Image.new("L", (24, 16), 255).save(path / "masks" / "0001.png")
    file = path / FILES["nerfstudio"]
    (cloud,) = path.glob("*.ply")
    text = file.read_text().replace(f'"{cloud.name}"', f'"/home/alice/old/{cloud.name}"')
    text = re.sub(
        r'("file_path": "[^"]*0001.png")', r'\1, "mask_path": "/data/masks/0001.png"', text
    )
    assert "/home/alice/" in text and "mask_path" in text
    file.write_text(text)
    scene = read(path, "nerfstudio")
    assert len(scene.points) == len(before.points)
    assert [view.photo.source.mask is not None for view in scene.views] == [False, True, False]
