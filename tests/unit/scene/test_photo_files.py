"""Names of photos that leave no room for what is looked for beside them."""

from PIL import Image

from crossgrad_core.scene.photo_files import PhotoFolder, find_mask

LONGEST = "a" * 251 + ".png"


def test_a_name_without_room_for_a_suffix_has_no_mask_of_that_name(tmp_path):
    assert find_mask(tmp_path, LONGEST) is None
    Image.new("L", (2, 2)).save(tmp_path / LONGEST)
    assert find_mask(tmp_path, LONGEST) == tmp_path / LONGEST


def test_a_name_that_is_too_long_has_no_photo(tmp_path):
    assert PhotoFolder(tmp_path).find("a" * 300 + ".png", ()) is None
    assert PhotoFolder(tmp_path).find("a/" * 3000 + "b.png", ()) is None
