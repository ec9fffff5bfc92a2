"""Photos are decoded once, early: before training what is held out, beside it the others."""

from dataclasses import replace
from threading import Event, Timer

import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import read_scene
from crossgrad_core.scene.photos.photos_ahead import AT_ONCE, PhotosAhead, check_photos, fits
from crossgrad_core.testing.fixtures import sample_scene

SECONDS = 30


def rotten(path):
    """Spoils the pixels of a photo; header and end stay, so that reading finds nothing."""
    content = bytearray(path.read_bytes())
    start, end = content.index(b"IDAT") + 4, content.rindex(b"IEND") - 8
    content[start:end] = bytes(end - start)
    path.write_bytes(content)


@pytest.fixture
def folder(tmp_path):
    return write_tiny_scene(tmp_path / "tiny", views=10)


def read(folder):
    return read_scene(RunConfig(), folder)[0]


@pytest.mark.parametrize("keep", [False, True])
def test_complete_photos_pass_the_check(folder, keep):
    scene = read(folder)
    check_photos(scene.test_views, keep=keep)
    assert (scene.views[0].photo.cache.used > 0) is keep


@pytest.mark.parametrize("keep", [False, True])
def test_every_held_out_photo_that_cannot_be_decoded_is_named(folder, keep):
    scene = read(folder)
    rotten(folder / "images" / "0000.png")
    with pytest.raises(UserError, match=r"the photo cannot be decoded(.|\n)*0000\.png"):
        check_photos(scene.test_views, keep=keep)
    rotten(folder / "images" / "0008.png")
    scene = read(folder)
    with pytest.raises(UserError, match=r"2 photos(.|\n)*0000\.png(.|\n)*0008\.png"):
        check_photos(scene.test_views, keep=keep)


def test_masks_are_decoded_by_the_check(folder):
    (folder / "masks").mkdir()
    mask = folder / "masks" / "0000.png"
    mask.write_bytes((folder / "images" / "0000.png").read_bytes())
    scene = read(folder)
    rotten(mask)
    with pytest.raises(UserError, match="masks"):
        check_photos(scene.test_views, keep=False)


def test_the_memory_check_counts_all_decoded_photos():
    scene = sample_scene()
    large = [replace(v, camera=v.camera.resized(1024, 1024)) for v in scene.views]
    scene = replace(scene, views=tuple(large))
    assert fits(scene, 4 * len(large))
    assert not fits(scene, 4 * len(large) - 1)


@pytest.mark.parametrize("keep", [False, True])
def test_a_broken_training_photo_is_reported_by_the_background_check(folder, keep):
    scene, found, told = read(folder), [], Event()
    rotten(folder / "images" / "0005.png")

    def report(error):
        found.append(error)
        told.set()

    with PhotosAhead().at_work(scene.train_views, report, keep=keep):
        assert told.wait(SECONDS)
    assert len(found) == 1 and "0005.png" in str(found[0])


class Slow:
    """A photo whose decoding can be held up; counts how many were asked for."""

    def __init__(self, gate):
        self.gate, self.asked = gate, Event()

    def image(self):
        self.asked.set()
        assert self.gate.wait(SECONDS)
        return torch.zeros((1, 1, 3), dtype=torch.uint8)

    def mask(self):
        return None


def test_the_background_check_ends_with_its_block():
    gate = Event()
    views = [replace(view, photo=Slow(gate)) for view in sample_scene().train_views]
    with PhotosAhead().at_work(views, pytest.fail, keep=False):
        assert all(view.photo.asked.wait(SECONDS) for view in views[:AT_ONCE])
        Timer(0.2, gate.set).start()  # After the block is left.
    assert gate.is_set()
    assert not views[AT_ONCE].photo.asked.is_set()


@pytest.mark.parametrize("error", [MemoryError(), ValueError("odd")])
def test_a_memory_error_of_the_background_check_is_ignored(error):
    class Broken:
        def image(self):
            asked.set()
            raise error

    asked, told, found = Event(), Event(), []
    view = replace(sample_scene().train_views[0], photo=Broken())

    def report(each):
        found.append(each)
        told.set()

    with PhotosAhead().at_work([view], report, keep=True):
        assert asked.wait(SECONDS)
        told.wait(0.2 if isinstance(error, MemoryError) else SECONDS)
    assert found == ([] if isinstance(error, MemoryError) else [error])
