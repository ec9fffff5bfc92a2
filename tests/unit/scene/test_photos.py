import os
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.photos import FilePhoto, PhotoCache, PhotoSource
from crossgrad_core.scene.photos.shapes import is_turned

RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (40, 60, 3), dtype=np.uint8)


@pytest.fixture
def source(tmp_path):
    Image.fromarray(RGB).save(tmp_path / "a.png")
    return PhotoSource(
        path=tmp_path / "a.png",
        width=60,
        height=40,
        orientation=1,
        mask=None,
        alpha=False,
        background=None,
        distorted=None,
        target=(60, 40),
    )


def save_mask(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "m.png")
    return tmp_path / "m.png"


def test_a_plain_photo_has_no_mask(source):
    photo = FilePhoto(source, PhotoCache(16))
    assert photo.mask() is None
    torch.testing.assert_close(photo.image(), torch.from_numpy(RGB))
    assert photo.image().dtype == torch.uint8
    assert photo.image() is photo.image()


def test_a_mask_of_half_the_size_is_enlarged_to_the_photo(source, tmp_path):
    mask = np.zeros((20, 30), dtype=np.uint8)
    mask[:, :10] = 255
    _, keep = replace(source, mask=save_mask(tmp_path, mask)).decode()
    assert keep.dtype == torch.bool
    assert keep[:, :20].all()
    assert not keep[:, 20:].any()


def test_a_white_mask_counts_as_no_mask(source, tmp_path):
    mask = save_mask(tmp_path, np.full((40, 60), 255, dtype=np.uint8))
    assert replace(source, mask=mask).decode()[1] is None


def test_mask_and_photo_are_resized_together(source, tmp_path):
    mask = np.full((40, 60), 255, dtype=np.uint8)
    mask[:20] = 0
    image, keep = replace(source, mask=save_mask(tmp_path, mask), target=(30, 20)).decode()
    assert image.shape == (20, 30, 3)
    assert not keep[:10].any()
    assert keep[10:].all()


def test_alpha_is_a_mask_or_is_blended(source):
    alpha = np.full((40, 60), 255, dtype=np.uint8)
    alpha[:, :30] = 127
    Image.fromarray(np.dstack([RGB, alpha])).save(source.path)
    see_through = replace(source, alpha=True)
    image, keep = see_through.decode()
    assert not keep[:, :30].any()
    assert keep[:, 30:].all()
    torch.testing.assert_close(image, torch.from_numpy(RGB))
    image, keep = replace(see_through, background=(1.0, 1.0, 1.0)).decode()
    assert keep is None
    assert torch.equal(image[:, 30:], torch.from_numpy(RGB[:, 30:]))
    assert image[:, :30].float().mean() > RGB[:, :30].mean() + 30


def test_a_photo_and_its_mask_are_turned_upright(source, tmp_path):
    mask = np.zeros((40, 60), dtype=np.uint8)
    mask[5, 7] = 255
    turned = replace(
        source, width=40, height=60, orientation=6, target=(40, 60), mask=save_mask(tmp_path, mask)
    )
    image, keep = turned.decode()
    np.testing.assert_array_equal(image, np.rot90(RGB, -1))
    assert keep.nonzero().tolist() == [[7, 34]]
    upright_mask = np.zeros((60, 40), dtype=np.uint8)
    upright_mask[7, 34] = 255
    _, keep = replace(turned, mask=save_mask(tmp_path, upright_mask)).decode()
    assert keep.nonzero().tolist() == [[7, 34]]


def test_a_mask_of_the_stored_photo_is_turned_at_any_size(source, tmp_path):
    mask = np.zeros((20, 30), dtype=np.uint8)
    mask[:, :15] = 255  # The left half, which comes to lie above.
    turned = replace(
        source, width=40, height=60, orientation=6, target=(40, 60), mask=save_mask(tmp_path, mask)
    )
    _, keep = turned.decode()
    assert keep[:30].all() and not keep[30:].any()


@pytest.mark.parametrize(
    ("mask", "turned"),
    [
        ((60, 40), False),
        ((40, 60), True),
        ((30, 20), False),
        ((20, 30), True),
        ((21, 30), True),
        ((40, 40), None),
        ((50, 50), None),
    ],
)
def test_a_mask_is_turned_if_its_shape_matches_the_turned_photo(mask, turned):
    assert is_turned(mask, (60, 40)) is turned
    assert is_turned((50, 50), (50, 50)) is False
    # Exact sizes tell first.
    assert is_turned((100, 101), (101, 100)) is True


def test_masks_are_undistorted_with_the_photo(source, tmp_path):
    calibration = Calibration("SIMPLE_RADIAL", 60, 40, (60.0, 30.0, 20.0, -0.1))
    spot = np.zeros((40, 60), dtype=np.uint8)
    spot[4:9, 6:13] = 255
    Image.fromarray(spot[..., None].repeat(3, 2)).save(source.path)
    frame = calibration.pinhole
    image, keep = replace(
        source,
        mask=save_mask(tmp_path, spot),
        distorted=calibration,
        target=(frame.width, frame.height),
    ).decode()
    assert image.shape == (frame.height, frame.width, 3)
    assert torch.equal(keep, image[..., 0] >= 128)


def test_pixels_outside_the_undistorted_photo_do_not_count(source):
    Image.new("RGB", (60, 40), "white").save(source.path)
    off_centre = Calibration("SIMPLE_RADIAL", 60, 40, (60.0, 0.0, 20.0, -0.1))
    frame = off_centre.pinhole
    blank = replace(source, distorted=off_centre, target=(frame.width, frame.height))
    assert blank.may_mask
    image, keep = blank.decode()
    assert 0.9 < keep.float().mean() < 1
    assert image[keep].min() == 255


def test_a_photo_with_a_changed_size_is_refused(source):
    Image.fromarray(RGB[:20]).save(source.path)
    with pytest.raises(UserError, match=r"has changed(?s:.*)60 x 40(?s:.*)60 x 20"):
        source.decode()


def test_the_origin_of_a_large_processed_photo_identifies_its_file(source, tmp_path):
    large = replace(source, width=2000, height=1500, target=(200, 150))
    assert source.origin is None
    assert replace(large, target=(2000, 1500)).origin is None
    assert replace(large, width=400, height=300, target=(40, 30), reduction=8).origin is not None
    lens = Calibration("SIMPLE_RADIAL", 2000, 1500, (1500.0, 1000.0, 750.0, -0.1))
    mask = save_mask(tmp_path, RGB[..., 0])
    others = [
        large,
        replace(large, target=(2000, 1500), distorted=lens),
        replace(large, target=(100, 75)),
        replace(large, orientation=6),
        replace(large, background=(1.0, 1.0, 1.0)),
        replace(large, mask=mask),
    ]
    origins = [each.origin for each in others]
    assert len(set(origins)) == len(others) and None not in origins
    assert [each.origin for each in others] == origins
    os.utime(mask, (1, 1))
    assert others[-1].origin != origins[-1]
    Image.fromarray(255 - RGB).save(source.path)
    assert all(each.origin not in origins for each in others)
    source.path.unlink()
    assert large.origin is None


class Counting:
    """Stands in for a source; counts how often it is decoded."""

    def __init__(self, size=1000):
        self.decoded = 0
        self.size = size

    def decode(self):
        self.decoded += 1
        return torch.zeros(self.size, dtype=torch.uint8), None


@pytest.fixture
def small_cache():
    cache = PhotoCache(0)
    cache.limit = 50_000
    return cache


def test_the_cache_stays_within_its_limit(small_cache):
    for size in [1000] * 70 + [30_000, 60_000, 10]:
        small_cache.get(Counting(size))
        assert small_cache.used <= max(50_000, size)


def test_photos_of_twice_the_cache_size_in_random_order_have_a_good_hit_rate(small_cache):
    sources = [Counting() for _ in range(100)]
    rng = np.random.default_rng(0)
    for _ in range(10):
        for i in rng.permutation(100):
            small_cache.get(sources[i])
    decoded = sum(source.decoded for source in sources)
    assert 100 <= decoded <= 700


def test_photos_of_one_step_are_decoded_once(small_cache):
    for _ in range(60):
        small_cache.get(Counting())
    step = [Counting() for _ in range(8)]
    for source in step * 3:
        small_cache.get(source)
    assert [source.decoded for source in step] == [1] * 8


def test_threads_can_share_the_cache(small_cache):
    sources = [Counting() for _ in range(30)]
    errors = []

    def work(seed):
        rng = np.random.default_rng(seed)
        try:
            for i in rng.integers(0, 30, 300):
                assert small_cache.get(sources[i])[0].shape == (1000,)
        except AssertionError as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert small_cache.used == 30_000
