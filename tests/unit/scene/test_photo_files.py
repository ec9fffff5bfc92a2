"""Names of photos that leave no room for what is looked for beside them."""

import pytest
from PIL import Image

from crossgrad_core.scene.photos.photo_files import PhotoFolder, find_mask

LONGEST = "a" * 251 + ".png"


def test_a_photo_name_of_maximum_length_has_a_mask_only_under_the_same_name(tmp_path):
    assert find_mask(tmp_path, LONGEST) is None
    Image.new("L", (2, 2)).save(tmp_path / LONGEST)
    assert find_mask(tmp_path, LONGEST) == tmp_path / LONGEST


def test_a_name_that_is_too_long_has_no_photo(tmp_path):
    assert not PhotoFolder(tmp_path).pair(["a" * 300 + ".png", "a/" * 3000 + "b.png"]).files


def test_the_first_existing_mask_name_is_used(tmp_path):
    for name in ("a/1.jpg", "a/1_mask.png", "a/1.png", "a/1.jpg.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
        assert find_mask(tmp_path, "a/1.jpg") == tmp_path / name
    assert find_mask(tmp_path, "a/2.jpg") is None


@pytest.mark.parametrize("suffix", [".avif", ".gif", ".webp", ".JPG"])
def test_a_photo_may_have_another_suffix_than_its_pose(tmp_path, suffix):
    (tmp_path / f"one{suffix}").touch()
    assert PhotoFolder(tmp_path).pair(["one.png"]).files == {"one.png": f"one{suffix}"}
