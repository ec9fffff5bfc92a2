"""Photos of fewer bits in files of 16: one value is white for all, and dark photos stay dark."""

import re
import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.registry.entries import build
from crossgrad_core.scene.photos.choose_photos import white_of
from crossgrad_core.scene.photos.decode import brightest, decode_photo
from crossgrad_core.scene.photos.headers import read_header

RAMP = np.linspace(0.0, 0.95, 40 * 60).reshape(40, 60)


def read(path):
    return build("readers", "colmap", {}).read(path, SceneOptions())


def write(path, white, scale=1.0):
    Image.fromarray((RAMP * scale * white).astype(np.uint16)).save(path)
    return path


def write_colors(path, values):
    """An RGB or RGBA photo of 16 bits, which Pillow does not write."""
    height, width, channels = values.shape

    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    kind = {3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    head = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


@pytest.mark.parametrize("white", [255, 1023, 4095, 16383])
def test_the_brightest_photo_determines_the_number_of_bits(white, tmp_path):
    photos = [write(tmp_path / f"{i}.tif", white, scale) for i, scale in enumerate((0.1, 1, 0.5))]
    found, (note,) = white_of(photos)
    assert found == white
    assert f"{white.bit_length()}-bit values" in note and f"{white} is white" in note
    rgb, alpha = decode_photo(photos[1], white=white)
    assert np.abs(rgb / 255 - RAMP[..., None]).max() < 0.51 / 255 + 1 / white
    assert rgb.shape == (40, 60, 3) and alpha is None


def test_photos_with_16_bits_are_not_rescaled(tmp_path):
    assert white_of([write(tmp_path / "a.png", 65535, 0.5)]) == (65535, [])
    assert white_of([]) == (65535, [])


@pytest.mark.parametrize("top", [0.0005, 0.03, 0.1, 0.15])
def test_dark_16_bit_photos_are_kept_dark_with_a_note(top, tmp_path):
    white, (note,) = white_of([write(tmp_path / "a.png", 65535, top)])
    assert white == 65535
    (share,) = re.findall(r"use ([\d.]+) % of their range", note)
    assert float(share) == pytest.approx(95 * top, rel=0.05) and "save them scaled" in note


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_photos_keep_all_their_bits(channels, tmp_path):
    values = np.random.default_rng(0).integers(0, 4096, (5, 7, channels)).astype(np.uint16)
    values[..., 3:] = 65535
    path = write_colors(tmp_path / "a.png", values)
    assert read_header(path).deep and brightest(path) == values[..., :3].max()
    rgb, alpha = decode_photo(path, white=4095)
    np.testing.assert_array_equal(rgb, np.rint(values[..., :3] * (255 / 4095)))
    assert (alpha is None) == (channels == 3)


def test_a_scene_of_12_bit_photos_is_read_at_the_right_brightness(tmp_path):
    path = write_tiny_scene(tmp_path, views=3, width=24, height=16, points=20, suffix=".tif")
    before = [float(view.photo.image().float().mean()) for view in read(path).views]
    for photo in (path / "images").iterdir():
        with Image.open(photo) as image:
            grey = np.asarray(image.convert("L")).astype(np.uint16)
        grey[0, 0] = 255
        Image.fromarray(grey * 16).save(photo)
    scene = read(path)
    assert "contain 12-bit values (up to 4080)" in " ".join(scene.notes)
    after = [float(view.photo.image().float().mean()) for view in scene.views]
    assert after == pytest.approx(before, abs=25)
