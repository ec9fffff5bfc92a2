"""Photos whose pixels are all masked are left out of training; the other photos stay."""

import numpy as np
import pytest
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_plugins.readers.colmap import ColmapReader

SIZE = (48, 32)


@pytest.fixture
def scene(tmp_path):
    return write_tiny_scene(tmp_path / "scene", views=9)


def read(path, **options):
    return ColmapReader().read(path, SceneOptions(**options))


def mask(path, name, pixels):
    (path / "masks").mkdir(exist_ok=True)
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(path / "masks" / f"{name}.png")


def black(count=0):
    """A mask with that many pixels that count."""
    pixels = np.zeros(SIZE[::-1], dtype=np.uint8)
    pixels.flat[:count] = 255
    return pixels


def names(scene, positions):
    return [scene.views[i].name for i in positions]


def trained(path, **options):
    found = read(path, **options)
    return names(found, found.train)


def test_a_fully_masked_training_photo_is_left_out_and_named(scene):
    before = read(scene)
    mask(scene, "0001.png", black())
    after = read(scene)
    assert names(after, after.train) == [n for n in names(before, before.train) if n != "0001.png"]
    assert names(after, after.test) == names(before, before.test)
    (note,) = [note for note in after.notes if "all pixels are masked" in note]
    assert "1 training photo left out" in note and "0001.png" in note
    assert all(view.photo.mask() is None or view.photo.mask().any() for view in after.train_views)


def test_a_transparent_training_photo_is_left_out(scene):
    Image.new("RGBA", SIZE).save(scene / "images" / "0001.png")
    assert "0001.png" not in trained(scene)


@pytest.mark.parametrize("count", [1, 40, 800])
def test_a_photo_with_some_unmasked_pixels_is_kept(scene, count):
    mask(scene, "0001.png", black(count))
    assert "0001.png" in trained(scene)


def test_a_photo_that_loses_its_last_unmasked_pixels_by_resizing_is_left_out(scene):
    mask(scene, "0001.png", black(1))
    assert "0001.png" not in trained(scene, max_size=16)


def test_a_fully_masked_held_out_photo_is_kept(scene):
    before = read(scene)
    mask(scene, names(before, before.test)[0], black())
    assert len(read(scene).test) == len(before.test)


def test_a_scene_of_fully_masked_photos_is_refused(scene):
    for photo in (scene / "images").iterdir():
        mask(scene, photo.name, black())
    with pytest.raises(UserError, match="every pixel of every training photo") as refused:
        read(scene)
    assert "invert the masks" in refused.value.todo


def test_photos_without_masks_are_not_decoded(scene, monkeypatch):
    def decoded(*args):
        raise AssertionError("a photo was decoded")

    monkeypatch.setattr("crossgrad_core.scene.photos.photos.PhotoSource.decode", decoded)
    monkeypatch.setattr("crossgrad_core.scene.build.decode_photo", decoded)
    mask(scene, "0001.png", np.full(SIZE[::-1], 255))
    assert len(read(scene).views) == 9
