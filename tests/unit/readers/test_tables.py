"""RealityCapture's table in the forms in which programs and people save it."""

import re

import pytest
from support.formats import FORMATS, Written
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import read_scene


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("colmap")
    return Written.of(
        write_tiny_scene(root / "scene", views=3, width=24, height=16, points=20, centered=True)
    )


@pytest.fixture
def scene(written, tmp_path):
    FORMATS["realitycapture"](written, tmp_path)
    return tmp_path


def read(path):
    return read_scene(RunConfig(scene=path), path)


def cameras(scene):
    return [repr(view.camera) for view in scene.views]


def decimal_commas(text):
    return re.sub(r"(\d)\.(\d)", r"\1,\2", text.replace(",", ";")).replace(",png", ".png")


def upper_case(text):
    header, _, rows = text.partition("\n")
    return header.upper() + "\n" + rows


CHANGES = {
    "semicolons": lambda text: text.replace(",", ";"),
    "tabs": lambda text: text.replace(",", "\t"),
    "decimal commas": decimal_commas,
    "no hash": lambda text: text.replace("#name", "name"),
    "a hash and a space": lambda text: text.replace("#name", "# Name"),
    "upper case": upper_case,
    "spaces": lambda text: text.replace(",", ", "),
    "comments": lambda text: "#cameras 3\n# made by hand, today\n\n" + text + "# the end\n",
    "a byte order mark": lambda text: "\ufeff" + text,
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "separators at the end": lambda text: text.replace("\n", ",\n"),
    "quotes": lambda text: re.sub(r"(\d{4}\.png)", r'"\1"', text),
    "absolute names": lambda text: re.sub(r"(\d{4}\.png)", r"C:\\photos\\\1", text),
    "names in capitals": lambda text: text.replace(".png", ".PNG"),
}


@pytest.mark.parametrize("form", CHANGES)
def test_a_realitycapture_table_is_read_in_all_forms_in_which_it_may_be_saved(form, scene):
    (file,) = scene.glob("*.csv")
    before, _ = read(scene)
    changed = CHANGES[form](file.read_text())
    assert changed != file.read_text()
    file.write_bytes(changed.encode())
    after, reader = read(scene)
    assert reader == "realitycapture"
    assert cameras(after) == cameras(before)
    assert not [note for note in after.notes if "unused" in note or "left out" in note]


def test_the_file_suffix_may_be_in_capitals(scene):
    (file,) = scene.glob("*.csv")
    file.rename(file.with_suffix(".CSV"))
    assert read(scene)[1] == "realitycapture"


@pytest.mark.parametrize(
    ("old", "new", "missing"),
    [
        (",f,", ",focal,", "a column f"),
        ("heading", "yaw", "a column heading"),
        ("#name", "image", "a column #name"),
    ],
)
def test_a_table_without_a_required_column_is_reported(old, new, missing, scene):
    (file,) = scene.glob("*.csv")
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(UserError, match="CSV file of RealityCapture") as caught:
        read(scene)
    assert caught.value.where == str(file) and caught.value.expected == missing


def test_a_table_in_utf_16_is_reported(scene):
    (file,) = scene.glob("*.csv")
    file.write_bytes(file.read_text().encode("utf-16"))
    with pytest.raises(UserError, match="CSV file of RealityCapture") as caught:
        read(scene)
    assert caught.value.where == str(file)


def test_a_quote_in_a_comment_gives_an_error(scene):
    (file,) = scene.glob("*.csv")
    file.write_text('"a comment\n' + file.read_text())
    with pytest.raises(UserError, match="CSV file of RealityCapture"):
        read(scene)


def test_a_similar_table_does_not_prevent_the_use_of_another_reader(tmp_path):
    path = write_tiny_scene(tmp_path, views=2, width=24, height=16, points=20)
    (path / "gps.csv").write_text("name,x,y,alt,heading\n")
    assert read(path)[1] == "colmap"
