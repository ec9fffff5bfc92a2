"""Photos of a folder: names, EXIF, masks, and files that only look like photos."""

import os
import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import pillow
from crossgrad_plugins.prepare import photos
from crossgrad_plugins.prepare.masks import counting_pixels
from crossgrad_plugins.prepare.photos import camera_of, find_photos, position_of
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
def test_degrees_minutes_and_seconds_are_combined(latitude, longitude, altitude, south):
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
def test_invalid_gps_tags_give_no_position(tags):
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


def test_masks_are_found_under_all_supported_names_and_do_not_count_as_photos(tmp_path):
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


@pytest.mark.parametrize("wanted", [False, True])
def test_masks_are_paired_by_the_rule_of_the_readers(wanted, tmp_path):
    """Letter case, suffix, and words such as `mask` at the start or the end may differ."""
    for number, mask in enumerate(("Mask_1.png", "2_SEG.png", "3.tif"), 1):
        save(tmp_path / f"{number}.JPG")
        save(tmp_path / "masks" / mask)
    used, left_out = found(tmp_path, masks=str(tmp_path / "masks") if wanted else None)
    assert [Path(used[f"{i}.JPG"].mask).name for i in (1, 2, 3)] == [
        "Mask_1.png",
        "2_SEG.png",
        "3.tif",
    ]
    assert not any("without a photo" in why for why in left_out.values())


def test_a_named_mask_folder_must_exist(tmp_path):
    save(tmp_path / "1.jpg")
    with pytest.raises(UserError, match="mask folder"):
        found(tmp_path, masks=str(tmp_path / "gone"))


def test_masks_in_photo_folders_do_not_count_as_photos_and_are_reported(tmp_path):
    """Most files in `a/masks` have names of photos. `b/masks` contains photos of carnival masks."""
    shot = ("a/1.jpg", "a/2.jpg", "b/1.jpg", "b/masks/7.jpg", "b/masks/8.jpg", "c/3.jpg")
    drawn = ("c/masks/3.png", "a/masks/1.jpg.png", "a/masks/2.png", "a/masks/gone.png")
    for name in (*shot, *drawn):
        save(tmp_path / name)
    used, left_out = found(tmp_path)
    assert sorted(used) == sorted(shot)
    assert left_out == {
        "a/masks/": "masks; 1 file without a photo: a/masks/gone.png",
        "c/masks/": "masks of the photos next to it",
    }
    masked = {name: photo.mask for name, photo in used.items() if photo.mask}
    assert masked == {
        "a/1.jpg": str(tmp_path / "a/masks/1.jpg.png"),
        "a/2.jpg": str(tmp_path / "a/masks/2.png"),
        "c/3.jpg": str(tmp_path / "c/masks/3.png"),
    }


def test_masks_without_a_photo_are_reported(tmp_path):
    for name in (
        "1.jpg",
        "2.jpg",
        "masks/1.png",
        "masks/IMG_9.jpg",
        "death_mask.jpg",
        "1_mask.jpg",
        "2.mask.png",
    ):
        save(tmp_path / name)
    used, left_out = found(tmp_path)
    assert sorted(used) == ["1.jpg", "2.jpg"]
    assert left_out == {
        "masks/": "masks; 1 file without a photo: masks/IMG_9.jpg",
        "death_mask.jpg": "named like a mask, but without a photo: rename it if it is a photo",
        "1_mask.jpg": "the name of a mask next to its photo must end in .png",
    }
    assert used["2.jpg"].mask == str(tmp_path / "2.mask.png")


@pytest.mark.parametrize("linked", [False, True])
def test_images_of_a_named_mask_folder_inside_the_photos_do_not_count_as_photos(linked, tmp_path):
    folder = tmp_path / "photos"
    for name in ("1.jpg", "2.jpg", "sky/1.jpg", "sky/deep/9.png"):
        save(folder / name)
    named = folder / "sky"
    if linked:
        named = tmp_path / "link"
        named.symlink_to(folder / "sky")
    used, left_out = found(folder, masks=str(named))
    assert sorted(used) == ["1.jpg", "2.jpg"]
    assert used["1.jpg"].mask == str(named / "1.jpg") and used["2.jpg"].mask is None
    assert left_out == {"sky/": "the folder of masks (--masks), not of photos"}


def test_the_folder_of_the_photos_may_also_contain_the_masks(tmp_path):
    """A photo is not used as its own mask."""
    for name in ("1.jpg", "1.png", "2.png", "2.png.png", "3.png"):
        save(tmp_path / name)
    used, _ = found(tmp_path, masks=str(tmp_path))
    assert sorted(used) == ["1.jpg", "2.png", "3.png"]
    assert used["1.jpg"].mask == str(tmp_path / "1.png")
    assert used["2.png"].mask == str(tmp_path / "2.png.png")
    assert used["3.png"].mask is None


@pytest.mark.parametrize("files", [(), ("other.png", "1.txt")])
def test_a_mask_folder_without_matching_names_is_refused(files, tmp_path):
    save(tmp_path / "photos" / "a" / "1.jpg")
    save(tmp_path / "photos" / "a" / "2.jpg")
    (tmp_path / "sky").mkdir()
    for name in files:
        save(tmp_path / "sky" / name, format="PNG")
    with pytest.raises(UserError, match="no mask for any photo") as caught:
        found(tmp_path / "photos", masks=str(tmp_path / "sky"))
    assert "a/1.jpg.png, a/1.png, a/1_mask.png, a/1.jpg" in caught.value.expected
    assert caught.value.found == ("other.png" if files else "no image")


def mask_of(folder, photo, mask, turn=1):
    """The pixels that count of a photo, with its stored size, its mask and its orientation."""
    exif = Image.Exif()
    exif[0x0112] = turn
    save(folder / "photos" / "1.jpg", size=photo, exif=exif)
    save(folder / "photos" / "2.jpg", size=photo)
    (folder / "photos" / "masks").mkdir()
    mask.save(folder / "photos" / "masks" / "1.png")
    used, _ = found(folder / "photos")
    return counting_pixels(folder / "photos", used["1.jpg"])


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("part", [1, 2])
def test_masks_in_display_orientation_are_turned_to_the_stored_orientation(turn, part, tmp_path):
    """Pillow turns photos by their EXIF headers. Masks of the stored photo are not turned."""
    stored = np.zeros((80, 120), np.uint8)
    stored[:20, :40] = 255
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.fromarray(stored).save(tmp_path / "mask.png", exif=exif)
    with Image.open(tmp_path / "mask.png") as image:
        shown = ImageOps.exif_transpose(image).reduce(part) if turn > 4 else image.reduce(part)
    kept = mask_of(tmp_path, (120, 80), shown, turn)
    assert np.array_equal(kept, stored)


@pytest.mark.parametrize(
    ("size", "turn"), [((80, 120), 1), ((80, 120), 3), ((120, 90), 6), ((50, 50), 8)]
)
def test_a_mask_of_another_shape_gives_one_error_at_once(size, turn, tmp_path):
    with pytest.raises(UserError, match="aspect ratio of its photo") as caught:
        mask_of(tmp_path, (120, 80), Image.new("L", size), turn)
    assert caught.value.where.endswith("masks/1.png")


def test_damaged_masks_are_reported_at_once(tmp_path):
    for name in ("1.jpg", "2.jpg", "masks/1.png", "masks/2.png"):
        save(tmp_path / name)
    whole = (tmp_path / "masks" / "2.png").read_bytes()
    broken = bytearray(whole)
    broken[len(whole) // 2] ^= 255
    for content in (whole[:-30], b"", bytes(broken)):
        (tmp_path / "masks" / "2.png").write_bytes(content)
        with pytest.raises(UserError) as caught:
            found(tmp_path)
        assert caught.value.where.endswith("masks/2.png")


def test_transparent_pixels_do_not_count(tmp_path):
    """Alpha counts only if it is below one half in some pixel. Alpha and a mask are combined."""
    pixels = np.random.default_rng(0).integers(0, 256, (80, 100, 4), dtype=np.uint8)
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(tmp_path / "opaque.png")
    pixels[:30, :, 3], pixels[30:, :, 3] = 127, 128
    Image.fromarray(pixels).save(tmp_path / "half.png")
    mask = np.full((80, 100), 255, np.uint8)
    mask[:, :50] = 0
    Image.fromarray(mask).save(tmp_path / "half_mask.png")
    palette = np.arange(8000, dtype=np.uint8).reshape(80, 100) % 2
    Image.fromarray(palette).convert("P").save(tmp_path / "palette.png", transparency=1)
    used, _ = found(tmp_path)
    assert {name: photo.transparent for name, photo in used.items()} == {
        "half.png": True, "opaque.png": False, "palette.png": True
    }  # fmt: skip
    kept = {name: counting_pixels(tmp_path, photo) for name, photo in used.items()}
    assert kept["opaque.png"] is None
    assert np.array_equal(kept["palette.png"], 255 * (1 - palette))
    assert kept["half.png"][30:, 50:].min() == 255
    assert not kept["half.png"][:30].any() and not kept["half.png"][:, :50].any()


@pytest.mark.parametrize(
    "name", ["a\tb.jpg", "a\nb.jpg", "a\x1b[2Jb.jpg", "a\\b.jpg", "d\te/1.jpg", "x" * 250 + ".jpg"]
)
def test_photos_with_unusable_names_are_left_out_with_a_reason(name, tmp_path):
    save(tmp_path / "1.jpg")
    save(tmp_path / "2.jpg")
    save(tmp_path / name)
    used, left_out = found(tmp_path)
    assert sorted(used) == ["1.jpg", "2.jpg"]
    ((shown, why),) = left_out.items()
    assert shown.isprintable()
    assert "control characters or backslashes, is too long or is not UTF-8: rename it" in why


def test_photos_with_undecodable_names_are_left_out_with_a_reason(tmp_path):
    for name in (b"1.jpg", b"2.jpg", b"\xff.jpg", b"\xfe_mask.png"):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
        with path.open("wb") as file:
            Image.effect_noise((90, 70), 20).save(file, "PNG")
    used, left_out = found(tmp_path)
    assert sorted(used) == ["1.jpg", "2.jpg"]
    assert all(shown.isprintable() for shown in left_out)
    assert len(left_out) == 2


@pytest.mark.parametrize("what", ["photos", "masks"])
def test_folders_with_undecodable_names_give_one_error(what, tmp_path):
    bad = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    bad.mkdir()
    with pytest.raises(UserError, match="not valid text"):
        found(bad) if what == "photos" else found(tmp_path, masks=str(bad))


@pytest.mark.parametrize(
    ("name", "options", "most"),
    [
        ("3.png", {}, 6299),
        ("3.jpg", {}, 3149),
        ("3.jpg", {"progressive": True}, 6299),
        ("3.tif", {}, 6299),
    ],
)
def test_a_photo_that_is_too_large_gives_one_error_with_its_name(
    name, options, most, tmp_path, monkeypatch
):
    """JPEG files that can be decoded at reduced size may have twice as many pixels."""
    for number in (1, 2):
        save(tmp_path / f"{number}.jpg", size=(64, 64))
    save(tmp_path / name, **options)
    monkeypatch.setattr(pillow, "MOST_PIXELS", most + 1)
    assert len(found(tmp_path)[0]) == 3
    monkeypatch.setattr(pillow, "MOST_PIXELS", most)
    read, decoded = photos._read, []
    monkeypatch.setattr(
        photos, "_read", lambda root, name, *more: decoded.append(name) or read(root, name, *more)
    )
    with pytest.raises(UserError, match="too large to be decoded") as caught:
        found(tmp_path)
    assert caught.value.where == str(tmp_path / name)
    assert (
        "90 x 70 pixels" in caught.value.found and "save it at a smaller size" in caught.value.todo
    )
    assert name not in decoded


def test_only_one_of_two_identical_photo_files_is_used(tmp_path):
    for name in ("b.jpg", "c.jpg"):
        save(tmp_path / name)
    shutil.copy(tmp_path / "b.jpg", tmp_path / "a.jpg")
    used, left_out = found(tmp_path)
    assert sorted(used) == ["a.jpg", "c.jpg"]
    assert left_out == {"b.jpg": "the same file as a.jpg"}


def test_names_with_spaces_and_symbols_are_accepted_and_hidden_files_are_ignored(tmp_path):
    save(tmp_path / "a b é.JPG", format="JPEG")
    save(tmp_path / "über uns" / "1,2.png")
    save(tmp_path / ".thumbnails" / "1.jpg")
    save(tmp_path / "._1.jpg")
    used, left_out = found(tmp_path)
    assert sorted(used) == ["a b é.JPG", "über uns/1,2.png"]
    assert not left_out


@pytest.mark.parametrize(
    ("mode", "words"), [("F", "floating point"), ("I", "32 bits"), ("1", "1 bit")]
)
def test_photos_with_pixel_types_that_colmap_cannot_write_are_left_out(mode, words, tmp_path):
    for name in ("good.jpg", "better.jpg"):
        save(tmp_path / name)
    levels = np.linspace(0, 1, 90 * 70).reshape(70, 90)
    scaled = {"F": levels.astype(np.float32), "I": (levels * 2**30).astype(np.int32)}
    image = Image.fromarray(scaled[mode]) if mode in scaled else Image.fromarray(levels > 0.5)
    image.save(tmp_path / "odd.tif")
    used, left_out = found(tmp_path)
    assert set(used) == {"good.jpg", "better.jpg"}
    assert words in left_out["odd.tif"]
