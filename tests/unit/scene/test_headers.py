import contextlib
import io
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.decode import decode_photo
from crossgrad_core.scene.photos.headers import PhotoHeader, read_header, read_quarter_turn

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)


def save(path, **options):
    Image.fromarray(PIXELS).save(path, **options)
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "bmp"])
def test_the_header_of_a_complete_photo_is_read(suffix, tmp_path):
    header = read_header(save(tmp_path / f"a.{suffix}"))
    assert header == PhotoHeader(60, 40, False, False, reducible=suffix == "jpg")


def test_a_progressive_jpeg_cannot_be_decoded_at_a_reduced_size(tmp_path):
    assert not read_header(save(tmp_path / "a.jpg", progressive=True)).reducible


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("share", [0.5, 0.97])
def test_a_truncated_photo_is_refused(suffix, share, tmp_path):
    path = save(tmp_path / f"a.{suffix}")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UserError, match=rf"incomplete|cannot be read(?s:.*)a\.{suffix}"):
        read_header(path)


def test_a_thumbnail_does_not_hide_a_truncated_photo(tmp_path):
    # A whole JPEG with its own end marker, as the EXIF header of a camera carries it.
    thumbnail = io.BytesIO()
    Image.fromarray(PIXELS[:8, :8]).save(thumbnail, "jpeg")
    exif = b"Exif\0\0" + thumbnail.getvalue()
    data = save(tmp_path / "a.jpg").read_bytes()
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    whole = data[:2] + segment + data[2:]
    (tmp_path / "a.jpg").write_bytes(whole)
    assert read_header(tmp_path / "a.jpg").width == 60
    (tmp_path / "a.jpg").write_bytes(whole[:-200])
    with pytest.raises(UserError, match="incomplete"):
        read_header(tmp_path / "a.jpg")


@pytest.mark.parametrize("trailer", [b"\0" * 500, b"SEFH trailer of a phone" * 9])
def test_extra_data_after_a_jpeg_is_allowed(trailer, tmp_path):
    path = save(tmp_path / "a.jpg")
    path.write_bytes(path.read_bytes() + trailer)
    assert read_header(path).height == 40


def test_a_jpeg_padded_with_zeros_counts_as_truncated(tmp_path):
    path = save(tmp_path / "a.jpg")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + b"\0" * (len(data) // 2))
    with pytest.raises(UserError, match="incomplete"):
        read_header(path)


@pytest.mark.parametrize(
    ("content", "found"), [(b"", "an empty file"), (b"hello", "an unknown image format")]
)
def test_a_file_that_is_not_a_photo_is_refused(content, found, tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(UserError, match=rf"not a photo(?s:.*)a\.jpg(?s:.*){found}"):
        read_header(path)


def test_a_photo_without_read_permission_is_named(tmp_path):
    (tmp_path / "a.jpg").mkdir()
    with pytest.raises(UserError, match=r"cannot be read(?s:.*)a\.jpg"):
        read_header(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("mode", "alpha", "grey"),
    [("L", False, True), ("LA", True, True), ("RGBA", True, False), ("I;16", False, True)],
)
def test_transparency_and_grey_are_detected(mode, alpha, grey, tmp_path):
    Image.new(mode, (60, 40)).save(tmp_path / "a.png")
    header = PhotoHeader(60, 40, alpha, grey, deep=mode == "I;16")
    assert read_header(tmp_path / "a.png") == header


@pytest.mark.parametrize(("orientation", "turn"), [(1, None), (3, None), (6, 6), (8, 8), (0, None)])
def test_quarter_turns_are_detected(orientation, turn, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = orientation
    assert read_quarter_turn(save(tmp_path / "a.jpg", exif=exif)) == turn


def with_size(data: bytes, width: int, height: int) -> bytes:
    """A JPEG or PNG file whose header claims another size."""
    if data.startswith(b"\x89PNG"):
        chunk = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_header_that_claims_more_pixels_than_the_file_can_hold_is_refused(suffix, tmp_path):
    path = save(tmp_path / f"a.{suffix}")
    path.write_bytes(with_size(path.read_bytes(), 12_000, 12_000))
    with pytest.raises(UserError, match=r"incomplete(?s:.*)12000 x 12000(?s:.*)to do"):
        read_header(path)


def test_the_largest_possible_photo_sizes_are_accepted(tmp_path):
    # One colour compresses as far as the formats allow.
    Image.new("1", (6000, 4000)).save(tmp_path / "a.png", compress_level=9)
    assert read_header(tmp_path / "a.png").width == 6000
    for progressive in (False, True):
        grey = Image.new("L", (6000, 4000))
        grey.save(tmp_path / "a.jpg", quality=1, optimize=True, progressive=progressive)
        assert read_header(tmp_path / "a.jpg").width == 6000


@pytest.mark.parametrize(
    "error", [KeyError("x"), struct.error("x"), IndexError(), NotImplementedError("x")]
)
def test_any_exception_of_a_decoder_becomes_one_error(error, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise error

    path = save(tmp_path / "a.jpg")
    monkeypatch.setattr(Image, "open", fail)
    for read in (read_header, read_quarter_turn):
        with pytest.raises(UserError, match=r"cannot be read(?s:.*)a\.jpg(?s:.*)to do"):
            read(path)


def test_memory_is_not_allocated_for_a_claimed_chunk_size(tmp_path):
    path = save(tmp_path / "a.png")
    data = path.read_bytes()
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + b"\x7f\xff\xff\xff" + data[at + 4 :])
    tracemalloc.start()
    try:
        with contextlib.suppress(UserError):
            decode_photo(path)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_only_photo_formats_are_opened(tmp_path):
    # Pillow would hand a PostScript file to Ghostscript.
    (tmp_path / "a.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EOF\n")
    with pytest.raises(UserError, match="not a photo"):
        read_header(tmp_path / "a.jpg")


def test_the_size_limit_of_pillow_is_not_changed(tmp_path):
    bound = Image.MAX_IMAGE_PIXELS
    read_header(save(tmp_path / "a.png"))
    assert bound == Image.MAX_IMAGE_PIXELS == 89_478_485
