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
def test_a_name_is_matched_with_the_most_similar_path(files, name, expected):
    assert pair(files, name).files == {name: expected}


@pytest.mark.parametrize("name", ["p0.png", "/data/p0.png", "x/p0.jpg"])
def test_a_name_that_fits_two_files_is_ambiguous(name):
    found = pair(TWO, name)
    assert not found.files
    assert {name: sorted(found.ambiguous[name])} == {name: list(TWO)}


def test_two_names_that_fit_one_file_equally_are_ambiguous():
    found = pair(("p0.png",), "/x/a/p0.png", "/x/b/p0.png")
    assert not found.files and set(found.ambiguous) == {"/x/a/p0.png", "/x/b/p0.png"}


def test_a_file_is_matched_with_the_name_most_similar_to_its_path():
    found = pair(("a/p0.png",), "/x/a/p0.png", "/x/b/p0.png")
    assert found.files == {"/x/a/p0.png": "a/p0.png"} and not found.ambiguous


def test_a_file_with_an_exact_name_is_matched_with_no_other_name():
    assert pair(TWO, "cam1/p0.png", "/data/p0.png").files == {
        "cam1/p0.png": "cam1/p0.png",
        "/data/p0.png": "cam0/p0.png",
    }


@pytest.mark.parametrize("name", ["cam0/p0.png", "/data/cam0/p0.png"])
def test_a_photo_missing_in_its_folder_is_not_replaced_by_a_photo_of_another_folder(name):
    found = pair(("cam0/p1.png", "cam1/p0.png"), name)
    assert not found.files and not found.ambiguous


def test_excluded_files_match_only_names_in_their_own_folder():
    def aside(name):
        return name.startswith("masks/")

    assert not pair(("masks/p0.png",), "p0.png", aside=aside).files
    assert pair(("masks/p0.png",), "masks/p0.jpg", aside=aside).files


@pytest.mark.parametrize("name", ["", ".", "/", "a/..", "\0", "\ud800", "\\"])
def test_empty_and_meaningless_names_match_no_file(name):
    assert not pair(("p0.png",), name).files


def test_file_names_may_differ_in_suffix_case_and_unicode_form():
    assert same_spelling("a/P0.PNG", "A/p0.jpg")
    assert not same_spelling("images/p0.png", "p0.png")
