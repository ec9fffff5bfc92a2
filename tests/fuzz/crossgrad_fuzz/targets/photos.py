"""Photo files: their headers, and their pixels."""

import io
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos import decode, headers, photo_store, photos, pillow, shapes
from crossgrad_core.scene.photos.decode import decode_photo
from crossgrad_core.scene.photos.headers import read_header, read_quarter_turn
from crossgrad_core.scene.photos.photos import PhotoSource
from crossgrad_core.scene.photos.shapes import choose_reduction
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import at_offsets
from crossgrad_fuzz.target import Mutator, Target

_PHOTO, _MASK = "photo.img", "mask.img"
#: While fuzzing, photos above this are too large: what a header claims must not be believed.
_MOST_PIXELS = 1 << 20
_SIZE = (24, 16)
#: Lenses whose photos reach all of the undistorted frame, and not all of it.
_FILLED, _UNFILLED = (20.0, 8.0, 12.0, -0.05), (14.9, 12.1, 14.8, -0.2)
_KINDS = (
    ("RGB", "JPEG", {"quality": 80}),
    ("RGB", "JPEG", {"quality": 80, "progressive": True}),
    ("CMYK", "JPEG", {"quality": 50}),
    ("RGB", "PNG", {}),
    ("RGBA", "PNG", {}),
    ("P", "PNG", {"transparency": 1}),
    ("I;16", "PNG", {}),
    ("1", "PNG", {}),
    ("RGB", "TIFF", {}),
    ("L", "TIFF", {"compression": "tiff_lzw"}),
    ("F", "TIFF", {}),
    ("I", "TIFF", {}),
    ("RGB", "WEBP", {"quality": 50}),
    ("RGBA", "WEBP", {"lossless": True}),
    ("RGB", "BMP", {}),
    ("L", "PPM", {}),
    ("P", "GIF", {}),
    ("RGB", "JPEG2000", {}),
)


def _saved(mode: str, form: str, options: dict[str, object], size: tuple[int, int]) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image = (
        image.convert("L").convert("I").convert("I;16") if mode == "I;16" else image.convert(mode)
    )
    if form in {"JPEG", "PNG", "WEBP"}:
        exif = Image.Exif()
        exif[0x0112] = 6
        options = {**options, "exif": exif}
    file = io.BytesIO()
    image.save(file, form, **options)
    return file.getvalue()


@cache
def _photos() -> Sequence[bytes]:
    return [_saved(*kind, _SIZE) for kind in _KINDS]


def _header_seeds() -> Sequence[Case]:
    return [{_PHOTO: content} for content in _photos()]


def _limited(parse: Callable[[Path], None]) -> Callable[[Path], None]:
    """Parses with a low bound on the pixels of a photo."""

    def limited(folder: Path) -> None:
        usual, pillow.MOST_PIXELS = pillow.MOST_PIXELS, _MOST_PIXELS
        try:
            parse(folder)
        finally:
            pillow.MOST_PIXELS = usual

    return limited


def _parse_header(folder: Path) -> None:
    path = folder / _PHOTO
    header = read_header(path)
    assert header.width > 0
    assert header.height > 0
    assert read_quarter_turn(path) in {None, 5, 6, 7, 8}
    for size in (None, 64, 4000):
        if size is None and header.width * header.height > _MOST_PIXELS and header.reducible:
            continue
        by = choose_reduction(path, header, size)
        small = header.reduced(by)
        assert 0 < small.width * small.height <= _MOST_PIXELS


def _pixel_seeds() -> Sequence[Case]:
    masks = [_saved("L", "PNG", {}, (12, 8)), _saved("1", "PNG", {}, (16, 24))]
    cases: list[Case] = [{_PHOTO: content} for content in _photos()]
    return [*cases, *({_PHOTO: cases[i][_PHOTO], _MASK: mask} for mask in masks for i in (3, 4))]


def _parse_pixels(folder: Path) -> None:
    path, mask = folder / _PHOTO, folder / _MASK
    rgb, alpha = decode_photo(path)
    assert rgb.dtype == np.uint8
    assert rgb.ndim == 3
    assert rgb.shape[2] == 3
    assert alpha is None or alpha.shape == rgb.shape[:2]
    small, _ = decode_photo(path, 4)
    assert small.shape[0] <= rgb.shape[0]
    for each in (
        *(_source(path, mask if mask.is_file() else None), _distorted(path, _FILLED)),
        _distorted(path, _UNFILLED),
    ):
        each.try_out()
        assert min(each.undistorted_size) > 0
        image, keep = each.decode()
        assert tuple(image.shape) == (each.target[1], each.target[0], 3)
        assert keep is None or keep.shape == image.shape[:2]


def _source(path: Path, mask: Path | None) -> PhotoSource:
    background = None if mask is None else (0.2, 0.4, 0.6)
    return PhotoSource(path, *_SIZE, 1, mask, True, background, None, (12, 8))


def _distorted(path: Path, params: tuple[float, ...]) -> PhotoSource:
    calibration = Calibration("SIMPLE_RADIAL", *_SIZE[::-1], params)
    pinhole = calibration.pinhole
    target = (pinhole.width, pinhole.height)
    return PhotoSource(path, *_SIZE[::-1], 6, None, True, None, calibration, target)


def _png_chunks(data: bytes, rng: random.Random) -> bytes:
    """A PNG with right checksums, so that what a chunk says is believed."""
    if not data.startswith(b"\x89PNG"):
        return data
    out, at = data[:8], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunk = data[at + 4 : at + 8 + min(length, len(data))]
        if rng.random() < 0.2 and chunk[:4] == b"IHDR":
            chunk = chunk[:4] + rng.choice(_png_sizes()) + chunk[12:]
        out += struct.pack(">I", max(0, len(chunk) - 4)) + chunk
        out += struct.pack(">I", zlib.crc32(chunk))
        at += 12 + length
    return out


def _png_sizes() -> tuple[bytes, ...]:
    sizes = ((1, 1), (0, 1), (24, 16), (1, 2**31 - 1), (60000, 60000), (1024, 1024), (2048, 1024))
    return tuple(struct.pack(">II", *size) for size in sizes)


def _sizes(data: bytes) -> list[tuple[int, int, str]]:
    """Where JPEG, PNG, BMP and GIF files keep their sizes."""
    jpeg = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    if jpeg >= 0:
        return [(jpeg + 5, 2, "I"), (jpeg + 7, 2, "I"), (jpeg + 9, 1, "I"), (jpeg + 2, 2, "I")]
    if data.startswith(b"BM"):
        return [(18, 4, "i"), (22, 4, "i"), (28, 2, "i"), (10, 4, "i")]
    if data.startswith(b"GIF"):
        return [(6, 2, "i"), (8, 2, "i")]
    return [(16, 4, "I"), (20, 4, "I"), (24, 1, "I"), (25, 1, "I")]


def _kept_seeds() -> Sequence[Case]:
    rng = np.random.default_rng(0)
    image = torch.from_numpy(rng.integers(0, 256, (*_SIZE[::-1], 3), dtype=np.uint8))
    mask = torch.from_numpy(rng.random(_SIZE[::-1]) < 0.5)
    return [{_PHOTO: b"".join(photo_store._packed((image, each)))} for each in (None, mask)]


def _parse_kept(folder: Path) -> None:
    found = photo_store._read(folder / _PHOTO, *_SIZE, None)
    if found is None:
        return
    image, mask = found
    assert image.shape == (*_SIZE[::-1], 3)
    assert mask is None or mask.shape == _SIZE[::-1]
    # What is read is what was kept, to the byte.
    kept = b"".join(photo_store._packed(found))
    assert (folder / _PHOTO).read_bytes()[: len(kept)] == kept


def _mended(data: bytes, rng: random.Random) -> bytes:
    """Other bits behind a checksum that fits."""
    content = bytearray(data[12:])
    for _ in range(rng.randrange(4) if content else 0):
        content[rng.randrange(len(content))] = rng.randrange(256)
    return data[:8] + zlib.crc32(content).to_bytes(4, "little") + bytes(content)


_FORMAT: tuple[Mutator, ...] = (_png_chunks, at_offsets(_sizes))
_WORDS = (
    *(b"\xff\xd8", b"\xff\xd9", b"\xff\xda", b"\xff\xc0", b"\xff\xc2", b"Exif\0\0"),
    *(b"IEND", b"IDAT", b"tRNS", b"acTL", b"PLTE", b"RIFF", b"WEBP", b"VP8X", b"GIF89a", b"BM"),
    *(b"II*\0", b"MM\0*", b"II+\0", b"P5\n24 16\n255\n", b"P7\n", b"8BPS", b"%!PS-Adobe"),
)

HEADERS = Target(
    name="photo-headers",
    seeds=_header_seeds,
    parse=_limited(_parse_header),
    parser={headers: (), shapes: (), pillow: ()},
    words=_WORDS,
    mutators=_FORMAT,
    quiet=False,
)
PIXELS = Target(
    name="photos",
    seeds=_pixel_seeds,
    parse=_limited(_parse_pixels),
    parser={decode: ("blend",), photos: ("PhotoCache", "FilePhoto", "_bytes"), pillow: ()},
    words=_WORDS,
    mutators=_FORMAT,
    quiet=False,
)
KEPT = Target(
    name="kept-photos",
    seeds=_kept_seeds,
    parse=_parse_kept,
    parser={
        photo_store: tuple(name for name in vars(photo_store) if name not in {"_read", "_packed"}),
    },
    mutators=(_mended,),
)
TARGETS = (HEADERS, PIXELS, KEPT)
