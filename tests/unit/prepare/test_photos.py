"""Photos of a folder: names, EXIF, masks, and files that only look like photos."""

import shutil
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from crossgrad_core.errors import UserError
from crossgrad_plugins.prepare.exif import camera_of, position_of
from crossgrad_plugins.prepare.photos import find_photos
from crossgrad_plugins.prepare.plan import Settings

GPS = 0x8825


def found(folder, **changed):
    used, left_out = find_photos(folder, Settings(**changed), lambda done, of: None)
    return {photo.name: photo for photo in used}, {each.name: each.why for each in left_out}


def save(path, size=(90, 70), **options):
    """Writes a photo like no other."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.effect_noise(size, 20).save(path, **options)


class Shown:
    """A photo of which nothing is known but its GPS tags."""

    def __init__(self, tags):
        self._tags = tags

    def getexif(self):
        return self

    def get_ifd(self, number):
        assert number == GPS
        return self._tags


@given(st.floats(0.1, 89.9), st.floats(-179.9, 179.9), st.floats(-400.0, 9000.0), st.booleans())
@settings(max_examples=50)
def test_degrees_minutes_and_seconds_are_put_together(latitude, longitude, altitude, south):
    latitude = -latitude if south else latitude

    def parts(angle):
        minutes = Fraction(abs(angle)) % 1 * 60
        return int(abs(angle)), int(minutes), float(minutes % 1 * 60)

    tags = {
        1: "S" if latitude < 0 else "N", 2: parts(latitude),
        3: "W" if longitude < 0 else "E", 4: parts(longitude),
        5: b"\1" if altitude < 0 else b"\0", 6: abs(altitude),
    }  # fmt: skip
    position = position_of(Shown(tags))
    assert position.latitude == pytest.approx(latitude, abs=1e-9)
    assert position.longitude == pytest.approx(longitude, abs=1e-9)
    assert position.altitude == pytest.approx(altitude, abs=1e-9)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {2: (1.0, 2.0, 3.0), 4: (1.0, 2.0, 3.0)},
        {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0), 6: 3.0},
        {2: (91.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0), 6: 3.0},
        {2: (float("nan"), 0.0, 0.0), 4: (0.0, 0.0, 0.0), 6: 3.0},
        {2: "here", 4: (), 6: "high"},
        {2: (), 4: (), 6: 3.0},
    ],
)
def test_what_is_no_place_is_none(tags):
    assert position_of(Shown(tags)) is None


def test_photos_of_one_camera_in_one_folder_share_a_calibration(tmp_path):
    exif = Image.Exif()
    exif[0x0110] = "Kite 1"
    save(tmp_path / "a" / "1.jpg", exif=exif)
    save(tmp_path / "a" / "2.jpg", exif=exif)
    save(tmp_path / "a" / "3.jpg")
    save(tmp_path / "a" / "4.jpg", size=(70, 90), exif=exif)
    save(tmp_path / "b" / "1.jpg", exif=exif)
    used, _ = found(tmp_path)
    cameras = [used[name].camera for name in sorted(used)]
    assert cameras[0] == cameras[1]
    assert len(set(cameras)) == 4
    assert len({photo.camera for photo in found(tmp_path, cameras="photo")[0].values()}) == 5
    with Image.open(tmp_path / "a" / "1.jpg") as image:
        assert camera_of(image) == "Kite 1"


def test_masks_are_found_by_all_their_names_and_are_no_photos(tmp_path):
    for number, mask in enumerate(
        ("masks/1.jpg.png", "masks/2.png", "masks/3_mask.png", "4_mask.png"), 1
    ):
        save(tmp_path / f"{number}.jpg")
        save(tmp_path / mask)
    save(tmp_path / "5.jpg")
    used, left_out = found(tmp_path)
    assert sorted(used) == [f"{number}.jpg" for number in range(1, 6)]
    assert not left_out
    assert [photo.mask is not None for _, photo in sorted(used.items())] == [True] * 4 + [False]


def test_a_folder_of_masks_that_is_named_has_to_be_there(tmp_path):
    save(tmp_path / "1.jpg")
    with pytest.raises(UserError, match="mask folder"):
        found(tmp_path, masks=str(tmp_path / "gone"))


def test_one_of_two_same_files_is_used(tmp_path):
    for name in ("b.jpg", "c.jpg"):
        save(tmp_path / name)
    shutil.copy(tmp_path / "b.jpg", tmp_path / "a.jpg")
    used, left_out = found(tmp_path)
    assert sorted(used) == ["a.jpg", "c.jpg"]
    assert left_out == {"b.jpg": "the same file as a.jpg"}


def test_names_with_spaces_and_signs_are_photos_and_hidden_files_are_not(tmp_path):
    save(tmp_path / "a b é.JPG", format="JPEG")
    save(tmp_path / "über uns" / "1,2.png")
    save(tmp_path / ".thumbnails" / "1.jpg")
    save(tmp_path / "._1.jpg")
    used, left_out = found(tmp_path)
    assert sorted(used) == ["a b é.JPG", "über uns/1,2.png"]
    assert not left_out
