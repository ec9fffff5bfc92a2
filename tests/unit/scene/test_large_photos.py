"""Photos of more pixels than are decoded at once: `--max-size` is the way out for JPEG files."""

import shutil
import zlib

import numpy as np
import pytest
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import decode, pillow
from crossgrad_core.scene.photos.decode import decode_photo, resize
from crossgrad_core.scene.photos.headers import PhotoHeader, read_header
from crossgrad_core.scene.photos.shapes import choose_reduction
from crossgrad_plugins.readers.colmap import ColmapReader

resource = pytest.importorskip("resource")

LIMIT = 179_000_000


def read(path, **options):
    return ColmapReader().read(path, SceneOptions(**options))


@pytest.fixture(scope="module")
def jpegs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("large") / "jpegs"
    return write_tiny_scene(folder, views=4, width=192, height=128, suffix=".jpg")


@pytest.fixture
def small_limit(monkeypatch):
    """As if 192 x 128 pixels were too many."""
    monkeypatch.setattr(pillow, "MOST_PIXELS", 10_000)


@pytest.mark.parametrize(
    ("size", "max_size", "reduction"),
    [
        ((13_000, 13_000), None, 1),
        ((13_000, 13_000), 100, 1),
        ((16_384, 12_288), 8192, 2),
        ((16_384, 12_288), 8193, 2),
        ((16_384, 12_288), 16_384, 2),
        ((16_384, 12_288), 4096, 4),
        ((16_384, 12_288), 3000, 4),
        ((16_384, 12_288), 1600, 8),
        ((65_000, 65_000), 20_000, 8),
    ],
)
def test_a_large_jpeg_is_reduced_as_far_as_the_requested_size_allows(size, max_size, reduction):
    header = PhotoHeader(*size, False, False, reducible=True)
    assert choose_reduction("a.jpg", header, max_size) == reduction
    small = header.reduced(reduction)
    assert small.width * small.height < LIMIT


@pytest.mark.parametrize(
    ("reducible", "max_size", "way"),
    [(True, None, "--max-size 4000"), (False, None, "_2, _4 or _8"), (False, 4000, "--max-size N")],
)
def test_the_error_about_a_large_photo_names_a_remedy(reducible, max_size, way):
    header = PhotoHeader(16_384, 12_288, False, False, reducible)
    with pytest.raises(UserError, match="too large") as caught:
        choose_reduction("a.jpg", header, max_size)
    message = str(caught.value)
    assert "16384 x 12288 pixels, 201.3 megapixels" in message
    assert "at most 179.0 megapixels" in message
    assert way in caught.value.todo


def test_a_scene_with_too_large_photos_requires_max_size(jpegs, small_limit):
    with pytest.raises(UserError, match=r"too large(?s:.*)\.jpg(?s:.*)--max-size"):
        read(jpegs)


def test_large_photos_are_trained_at_a_reduced_size(jpegs, small_limit, monkeypatch):
    scene = read(jpegs, max_size=90)
    assert any("4 photos above 0.0 megapixels decoded at 1/2" in note for note in scene.notes)
    monkeypatch.undo()
    whole = read(jpegs, max_size=90)
    for ours, theirs in zip(scene.views, whole.views, strict=True):
        assert ours.camera.matrix.tolist() == theirs.camera.matrix.tolist()
        image = ours.photo.image().numpy().astype(float)
        assert image.shape == (60, 90, 3)
        # The same photo to a few grey levels, however it is made smaller.
        assert np.abs(image - theirs.photo.image().numpy()).mean() < 4


def test_too_large_photos_are_accepted_if_a_folder_of_smaller_copies_exists(tmp_path, small_limit):
    scene = write_tiny_scene(tmp_path, views=4, width=192, height=128, suffix=".png")
    with pytest.raises(UserError, match="_2, _4 or _8"):
        read(scene, max_size=96)
    shutil.copytree(scene / "images", scene / "images_2")
    for path in (scene / "images_2").iterdir():
        with Image.open(path) as image:
            image.resize((96, 64)).save(path)
    assert read(scene, max_size=96).views[0].camera.width == 96


def test_a_mask_may_be_smaller_than_its_photo(jpegs, tmp_path, small_limit):
    scene = tmp_path / "scene"
    shutil.copytree(jpegs, scene)
    (scene / "masks").mkdir()
    Image.new("L", (192, 128), 255).save(scene / "masks/0000.jpg.png")
    with pytest.raises(UserError, match=r"mask is too large(?s:.*)save the mask at a smaller size"):
        read(scene, max_size=90)


def test_a_photo_that_grew_since_the_scan_is_refused(jpegs, small_limit):
    with pytest.raises(UserError, match=r"too large(?s:.*)changed"):
        decode_photo(jpegs / "images/0000.jpg")


def peak_mebibytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def test_a_photo_of_200_megapixels_is_decoded_in_little_memory(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("L", (16_384, 12_288), 90).save(path)
    header = read_header(path)
    reduction = choose_reduction(path, header, 1600)
    before = peak_mebibytes()
    rgb, _ = decode_photo(path, reduction)
    assert rgb.shape == (1536, 2048, 3)
    assert abs(int(resize(rgb, 160, 120)[5, 5, 0]) - 90) <= 1
    # The whole photo would take 590 MB, and as much again while it is converted.
    assert peak_mebibytes() - before < 100


def test_a_decompression_bomb_is_refused_before_memory_is_allocated(tmp_path):
    """The file has 49 kB and contains 400 megapixels of black."""
    width = height = 20_000
    header = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\1\0\0\0\0"
    pixels = b"IDAT" + zlib.compress(bytes((width // 8 + 1) * height), 9)
    chunks = (header, pixels, b"IEND")
    path = tmp_path / "a.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            (len(chunk) - 4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
            for chunk in chunks
        )
    )
    assert path.stat().st_size < 60_000
    before = peak_mebibytes()
    with pytest.raises(UserError, match="too large"):
        choose_reduction(path, read_header(path), 1600)
    with pytest.raises(UserError, match="too large"):
        decode_photo(path)
    assert peak_mebibytes() - before < 20


@pytest.mark.parametrize("height", [1, 6, 7, 8, 50])
@pytest.mark.parametrize("mode", ["RGB", "L", "P", "CMYK"])
def test_pixels_are_copied_in_bands(height, mode, tmp_path, monkeypatch):
    monkeypatch.setattr(decode, "_BAND", 7 * 3 * 23 + 5)  # Seven rows and a bit.
    noise = np.random.default_rng(height).integers(0, 256, (height, 23, 3), np.uint8)
    path = tmp_path / f"photo.{'tiff' if mode == 'CMYK' else 'png'}"
    Image.fromarray(noise).convert(mode).save(path)
    with Image.open(path) as image:
        wanted = np.asarray(image.convert("RGB"))
    rgb, alpha = decode_photo(path)
    assert alpha is None and np.array_equal(rgb, wanted)
