"""HEIC photos: read like others where pillow-heif is installed, else an error that names it."""

import sys

import numpy as np
import pytest
from PIL import Image

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import pillow
from crossgrad_core.scene.photos.decode import decode_photo
from crossgrad_core.scene.photos.headers import read_header
from crossgrad_core.scene.photos.photo_files import PhotoFolder

#: The first box of an iPhone's photo.
HEAD = b"\0\0\0\x24ftypheic\0\0\0\0mif1MiHBheic"


@pytest.fixture
def missing(monkeypatch):
    pillow._registered.cache_clear()
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    yield
    pillow._registered.cache_clear()


def test_the_error_names_the_missing_package(tmp_path, missing):
    path = tmp_path / "IMG_1.HEIC"
    path.write_bytes(HEAD + bytes(100))
    with pytest.raises(UserError, match=r"IMG_1\.HEIC(?s:.*)pillow-heif") as caught:
        read_header(path)
    assert "crossgrad[heic]" in caught.value.todo and "JPEG" in caught.value.todo


def test_other_photos_do_not_need_pillow_heif(tmp_path, missing):
    Image.new("RGB", (8, 6)).save(tmp_path / "a.heic", format="PNG")
    assert read_header(tmp_path / "a.heic").width == 8


def test_heic_photos_are_found_by_their_suffix(tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(HEAD)
    folder = PhotoFolder(tmp_path)
    assert folder.names == ("IMG_1.HEIC",)
    assert folder.pair(["img_1.jpg"]).files == {"img_1.jpg": "IMG_1.HEIC"}


@pytest.fixture
def photo(tmp_path):
    package = pytest.importorskip("pillow_heif")
    ramp = np.linspace(0, 255, 96 * 64 * 3).reshape(64, 96, 3).astype(np.uint8)
    path = tmp_path / "a.heic"
    package.from_pillow(Image.fromarray(ramp)).save(path, quality=-1)
    return path, ramp


def test_photos_of_phones_are_read(photo):
    path, ramp = photo
    header = read_header(path)
    assert (header.width, header.height, header.alpha, header.grey) == (96, 64, False, False)
    rgb, alpha = decode_photo(path)
    assert alpha is None and np.abs(rgb.astype(int) - ramp).max() <= 2


def test_a_truncated_heic_photo_is_an_error(photo):
    path, _ = photo
    content = path.read_bytes()
    for length in (13, len(content) // 3, len(content) // 2, len(content) - 20):
        path.write_bytes(content[:length])
        with pytest.raises(UserError, match=r"a\.heic"):
            decode_photo(path)
