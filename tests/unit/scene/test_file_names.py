"""Matching of names from other programs to files, with the reason if no file matches."""

import pytest

from crossgrad_core.scene.photos.file_names import FileNames, same_spelling

TWO = ("cam0/p0.png", "cam1/p0.png")


def pair(files, *names, **options):
    return FileNames(files, **options).pair(names)


@pytest.mark.parametrize(
    ("files", "name", "expected"),
    [
        (("p0.png", "p1.png"), "p1.png", "p1.png"),
        (("p0.png",), "images/p0.png", "p0.png"),
        (("p0.png",), "/home/alice/scene/images/p0.png", "p0.png"),
        (("p0.png",), "C:\\photos\\p0.png", "p0.png"),
        (("p0.png",), "../images/p0.png", "p0.png"),
        (("p0.JPG",), "images/P0.png", "p0.JPG"),
        (("cam0/p0.png",), "p0", "cam0/p0.png"),
        (TWO, "/data/cam0/p0.png", "cam0/p0.png"),
        (TWO, "D:\\rig\\CAM1\\p0.png", "cam1/p0.png"),
        (("p0.png", "sub/p0.png"), "/scene/images/p0.png", "p0.png"),
        (("p0.jpg", "p0.png"), "P0.PNG", "p0.png"),
        (("img.001.png", "img.png"), "img.001", "img.001.png"),
        (("e\u0301.png",), "images/\u00e9.png", "e\u0301.png"),
    ],
)
def test_a_name_stands_for_the_file_whose_path_is_most_alike(files, name, expected):
    assert pair(files, name).files == {name: expected}


@pytest.mark.parametrize("name", ["p0.png", "/data/p0.png", "x/p0.jpg"])
def test_a_name_that_fits_two_files_is_ambiguous(name):
    found = pair(TWO, name)
    assert not found.files
    assert {name: sorted(found.ambiguous[name])} == {name: list(TWO)}


def test_two_names_that_fit_one_file_alike_are_ambiguous():
    found = pair(("p0.png",), "/x/a/p0.png", "/x/b/p0.png")
    assert not found.files and set(found.ambiguous) == {"/x/a/p0.png", "/x/b/p0.png"}


def test_a_file_belongs_to_the_name_that_is_more_like_its_path():
    found = pair(("a/p0.png",), "/x/a/p0.png", "/x/b/p0.png")
    assert found.files == {"/x/a/p0.png": "a/p0.png"} and not found.ambiguous


def test_a_file_with_a_name_of_its_own_stands_for_no_other_name():
    assert pair(TWO, "cam1/p0.png", "/data/p0.png").files == {
        "cam1/p0.png": "cam1/p0.png",
        "/data/p0.png": "cam0/p0.png",
    }


@pytest.mark.parametrize("name", ["cam0/p0.png", "/data/cam0/p0.png"])
def test_a_photo_that_is_missing_in_its_folder_is_not_taken_from_another(name):
    found = pair(("cam0/p1.png", "cam1/p0.png"), name)
    assert not found.files and not found.ambiguous


def test_files_set_aside_stand_for_names_of_their_own_folder_only():
    def aside(name):
        return name.startswith("masks/")

    assert not pair(("masks/p0.png",), "p0.png", aside=aside).files
    assert pair(("masks/p0.png",), "masks/p0.jpg", aside=aside).files


@pytest.mark.parametrize("name", ["", ".", "/", "a/..", "\0", "\ud800", "\\"])
def test_names_of_nothing_stand_for_nothing(name):
    assert not pair(("p0.png",), name).files


def test_spelling_is_suffix_case_and_unicode_form():
    assert same_spelling("a/P0.PNG", "A/p0.jpg")
    assert not same_spelling("images/p0.png", "p0.png")
