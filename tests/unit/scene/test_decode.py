import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps
from skimage.transform import resize as skimage_resize

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.decode import blend, decode_mask, decode_photo, resize, turn

RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 256, (40, 60), dtype=np.uint8)
RGB = RNG.integers(0, 256, (40, 60, 3), dtype=np.uint8)


def test_grey_photos_have_three_equal_channels(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.png")
    rgb, alpha = decode_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb, GREY[..., None].repeat(3, 2))
    assert alpha is None


def test_16_bit_photos_are_rounded_to_8_bits(tmp_path):
    wide = RNG.integers(0, 65536, (40, 60)).astype(np.uint16)
    Image.fromarray(wide).save(tmp_path / "a.png")
    rgb, _ = decode_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb[..., 0], np.rint(wide / 257))
    Image.fromarray(wide).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(decode_photo(tmp_path / "a.tif")[0], rgb)


def test_alpha_is_returned_separately(tmp_path):
    Image.fromarray(np.dstack([RGB, GREY])).save(tmp_path / "a.png")
    rgb, alpha = decode_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb, RGB)
    np.testing.assert_array_equal(alpha, GREY)


def test_a_transparent_palette_colour_is_alpha(tmp_path):
    image = Image.new("P", (60, 40), 0)
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.putpixel((3, 2), 1)
    image.save(tmp_path / "a.png", transparency=1)
    rgb, alpha = decode_photo(tmp_path / "a.png")
    assert tuple(rgb[0, 0]) == (10, 20, 30)
    assert (alpha[2, 3], alpha[0, 0]) == (0, 255)


def test_float_photos_are_refused(tmp_path):
    Image.fromarray(GREY.astype(np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match=r"a\.tif(?s:.*)floating-point"):
        decode_photo(tmp_path / "a.tif")


@pytest.mark.parametrize("decode", [decode_photo, decode_mask])
def test_a_damaged_photo_is_named(decode, tmp_path):
    Image.fromarray(RGB).save(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"cannot be decoded(?s:.*)a\.jpg"):
        decode(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("mask", "mode"),
    [
        (np.where(GREY > 127, 255, 0).astype(np.uint8), "L"),
        (GREY, "L"),
        ((GREY > 127).astype(np.uint8), "L"),
        ((GREY > 127).astype(np.uint16) * 65535, "I;16"),
        (GREY > 127, "1"),
    ],
)
def test_masks_keep_their_white_pixels(mask, mode, tmp_path):
    image = Image.fromarray(mask)
    assert image.mode == mode
    image.save(tmp_path / "m.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "m.png"), np.where(GREY > 127, 255, 0))


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_the_white_value_of_a_mask_follows_its_number_of_bits(bits, tmp_path):
    wide = np.where(GREY > 127, 2**bits - 1, 0).astype(np.uint16)
    Image.fromarray(wide).save(tmp_path / "m.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "m.png"), np.where(GREY > 127, 255, 0))


@pytest.mark.parametrize("colors", ["white", "black", "the photo"])
def test_the_mask_is_the_alpha_if_only_alpha_is_black_and_white(colors, tmp_path):
    alpha = np.where(GREY > 127, 255, 0).astype(np.uint8)
    rgb = {"white": RGB * 0 + 255, "black": RGB * 0, "the photo": RGB}[colors]
    Image.fromarray(np.dstack([rgb, alpha]).astype(np.uint8)).save(tmp_path / "m.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "m.png"), alpha)


@pytest.mark.parametrize("alpha", [255, 128, GREY])
def test_alpha_of_a_black_and_white_mask_is_ignored(alpha, tmp_path):
    mask = np.where(GREY > 127, 255, 0).astype(np.uint8)
    layers = np.dstack([mask, mask, mask, np.broadcast_to(alpha, mask.shape)])
    Image.fromarray(layers.astype(np.uint8)).save(tmp_path / "m.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "m.png"), mask)


def test_a_black_mask_keeps_nothing(tmp_path):
    Image.new("L", (60, 40)).save(tmp_path / "m.png")
    assert not decode_mask(tmp_path / "m.png").any()


@pytest.mark.parametrize("orientation", [1, 5, 6, 7, 8])
def test_quarter_turns_agree_with_exif_orientations(orientation):
    image = Image.fromarray(RGB)
    image.getexif()[0x0112] = orientation
    np.testing.assert_array_equal(turn(RGB, orientation), ImageOps.exif_transpose(image))


def test_resizing_agrees_with_the_anti_aliased_resize_of_scikit_image():
    expected = skimage_resize(RGB, (13, 20), anti_aliasing=True) * 255
    assert np.abs(resize(RGB, 20, 13) - expected).max() <= 0.51


def test_resizing_to_the_same_size_changes_nothing():
    assert resize(RGB, 60, 40) is RGB


def test_blending_adds_a_background_colour():
    alpha = np.zeros((40, 60), dtype=np.uint8)
    alpha[:20] = 255
    mixed = blend(RGB, alpha, (1.0, 0.5, 0.0))
    np.testing.assert_array_equal(mixed[:20], RGB[:20])
    assert tuple(mixed[30, 30]) == (255, 128, 0)


@settings(max_examples=80, deadline=None)
@given(
    old=st.tuples(st.integers(1, 90), st.integers(1, 90)),
    new=st.tuples(st.integers(1, 90), st.integers(1, 90)),
    kind=st.sampled_from(["noise", "mask", "grey"]),
    seed=st.integers(0, 99),
)
@example((90, 90), (45, 30), "noise", 0)
@example((61, 1), (60, 1), "noise", 0)
@example((7, 90), (1, 2), "mask", 1)
def test_reducing_photos_gives_the_bits_of_scikit_image(old, new, kind, seed):
    height, width = (min(pair) for pair in zip(old, new, strict=True))
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, old if kind == "grey" else (*old, 3), dtype=np.uint8)
    if kind == "mask":
        image = np.where(rng.random(old) < 0.5, 255, 0).astype(np.uint8)
    whole = skimage_resize(image.astype(np.float32), (height, width), anti_aliasing=True)
    np.testing.assert_array_equal(resize(image, width, height), np.rint(whole).clip(0, 255))


def test_resizing_may_enlarge_one_side_of_a_photo():
    whole = skimage_resize(RGB.astype(np.float32), (50, 30), anti_aliasing=True)
    np.testing.assert_array_equal(resize(RGB, 30, 50), np.rint(whole).clip(0, 255))
