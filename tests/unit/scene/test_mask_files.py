"""Masks by name: which file of a mask folder belongs to which photo."""

from pathlib import Path

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.photo_files import check_masks, find_mask_folder, pair_masks


def found(folder, masks, *photos):
    for mask in masks:
        (folder / mask).parent.mkdir(parents=True, exist_ok=True)
        (folder / mask).touch()
    pairs = pair_masks(folder, photos)
    return {name: path.relative_to(folder).as_posix() for name, path in pairs.items()}


@pytest.mark.parametrize(
    "mask",
    [
        *("p0.jpg", "P0.PNG", "p0.png.PNG", "p0.tiff", "images/p0.png"),
        *("mask_p0.png", "p0-mask.png", "p0_MASK.jpg", "p0.mask.png", "p0.png_mask.png"),
        *("p0_seg.tif", "alpha p0.png"),
    ],
)
def test_a_mask_name_may_differ_in_suffix_case_folder_and_mask_word(mask, tmp_path):
    assert found(tmp_path, [mask], "p0.png", "p1.png") == {"p0.png": mask}


@pytest.mark.parametrize("mask", ["segmentation_of_p0.png", "p00.png", "mask.png", "p0.5.png"])
def test_other_names_do_not_match_a_photo(mask, tmp_path):
    assert not found(tmp_path, [mask], "p0.png")


def test_the_mask_of_another_photo_is_not_used(tmp_path):
    masks = ["p0_mask.png", "p0.png"]
    assert found(tmp_path, masks, "p0.png", "p0_mask.jpg") == {
        "p0.png": "p0.png",
        "p0_mask.jpg": "p0_mask.png",
    }


@pytest.mark.parametrize("masks", [["mask_p0.png", "p0_seg.png"], ["p0.jpg", "p0.bmp"]])
def test_two_possible_masks_give_no_mask(masks, tmp_path):
    assert not found(tmp_path, masks, "p0.png")


def test_one_mask_is_not_used_for_photos_of_two_folders(tmp_path):
    assert not found(tmp_path, ["p0.png"], "cam0/p0.png", "cam1/p0.png")
    assert found(tmp_path, ["p1.png"], "cam0/p2.png", "cam1/p1.png") == {"cam1/p1.png": "p1.png"}


def test_the_default_mask_folder_may_be_written_in_capitals(tmp_path):
    assert find_mask_folder(None, tmp_path) is None
    (tmp_path / "Masks").mkdir()
    assert find_mask_folder(None, tmp_path) == tmp_path / "Masks"


def test_a_mask_folder_without_matches_is_refused_unless_it_is_the_empty_default(tmp_path):
    check_masks(tmp_path, None, 0, ["p0.png"])
    with pytest.raises(UserError, match="no mask for any photo"):
        check_masks(tmp_path, Path("masks"), 0, ["p0.png"])
    (tmp_path / "other.png").touch()
    with pytest.raises(UserError, match="no mask for any photo") as caught:
        check_masks(tmp_path, None, 0, ["p0.jpg"])
    assert "p0_mask.png" in caught.value.expected and caught.value.found == "other.png"
