"""The one file of a program in a scene's folder: found by what it holds, or named."""

import pytest
from support.formats import FORMATS, Written
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build

KINDS = {"metashape": ("XML", "cameras.xml"), "realitycapture": ("CSV", "cameras.csv")}


@pytest.fixture(params=KINDS)
def program(request):
    return request.param


@pytest.fixture(scope="module")
def colmap(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("colmap") / "scene", views=3, centered=True)


@pytest.fixture
def scene(program, tmp_path, colmap):
    FORMATS[program](Written.of(colmap), tmp_path)
    return tmp_path


def file_of(scene, program):
    (file,) = scene.glob(f"*.{KINDS[program][0].lower()}")
    return file


def read(program, scene, **options):
    return build("readers", program, options).read(scene, SceneOptions())


def test_other_files_with_the_same_suffix_are_ignored(program, scene):
    file = file_of(scene, program)
    file.with_stem("a_list").write_text("no such columns\n")
    assert build("readers", program, {}).accepts(scene)
    assert len(read(program, scene).views) > 0


def test_the_named_file_is_read_if_two_files_fit(program, scene):
    file = file_of(scene, program)
    file.with_stem("other").write_bytes(file.read_bytes())
    with pytest.raises(UserError, match=f"several {KINDS[program][0]}s") as caught:
        read(program, scene)
    assert file.name in str(caught.value) and "reader.file" in str(caught.value)
    assert len(read(program, scene, file=file.name).views) > 0


def test_the_error_for_a_missing_file_names_its_contents(program, scene):
    file_of(scene, program).unlink()
    assert not build("readers", program, {}).accepts(scene)
    with pytest.raises(UserError, match=f"no {KINDS[program][0]} of"):
        read(program, scene)


@pytest.mark.parametrize("name", ["../cameras.xml", "/etc/hostname", "[", ""])
def test_a_file_name_that_is_not_in_the_scene_is_refused(program, scene, name):
    assert not build("readers", program, {"file": name}).accepts(scene)
    with pytest.raises(UserError):
        read(program, scene, file=name)
