"""Photos decoded before they are asked for: in order, within the memory, once."""

from dataclasses import replace
from threading import Event

import pytest
import torch

from crossgrad_core.scene.photos import photos
from crossgrad_core.scene.photos.photos import FilePhoto, PhotoCache
from crossgrad_core.scene.photos.photos_ahead import AT_ONCE, PhotosAhead
from crossgrad_core.testing.fixtures import sample_scene

SECONDS = 30


class Source:
    """Decodes to its number; tells when, and may wait."""

    def __init__(self, number, log, gate=None, error=None):
        self.number, self.log, self.gate, self.error = number, log, gate, error
        self.done = Event()

    origin = None
    may_mask = False
    decoded_bytes = 1000

    def decode(self):
        self.log.append(self.number)
        if self.gate is not None:
            assert self.gate.wait(SECONDS)
        self.done.set()
        if self.error is not None:
            raise self.error
        return torch.full((1000,), self.number, dtype=torch.uint8), None

    def try_out(self):
        self.log.append(f"tried {self.number}")
        self.done.set()


@pytest.fixture
def log():
    return []


def views_of(sources, limit=10**6):
    cache = PhotoCache(1)
    cache.limit = limit
    view = sample_scene().train_views[0]
    return [replace(view, photo=FilePhoto(source, cache)) for source in sources]


def all_done(sources):
    return all(source.done.wait(SECONDS) for source in sources)


def test_expected_photos_are_decoded_before_unseen_photos(log):
    gate = Event()
    first = [Source(number, log, gate) for number in range(AT_ONCE)]
    sources = [Source(number, log) for number in range(10, 16)]
    views, ahead = views_of([*first, *sources]), PhotosAhead()
    with ahead.at_work(views, pytest.fail, keep=True):
        while len(log) < AT_ONCE:
            gate.wait(0.01)
        ahead.expect([views[-1], views[-2]])
        gate.set()
        assert all_done(sources)
    assert log[AT_ONCE : AT_ONCE + 2] in ([15, 14], [14, 15])
    assert sorted(log) == sorted(source.number for source in (*first, *sources))


def test_decoding_ahead_ends_once_all_photos_are_in_memory(log):
    sources = [Source(number, log) for number in range(5)]
    views, ahead = views_of(sources), PhotosAhead()
    assert not ahead.useful
    with ahead.at_work(views, pytest.fail, keep=True):
        assert all_done(sources)
        while ahead.useful:
            Event().wait(0.01)
        ahead.expect(views)
    assert sorted(log) == list(range(5))


def test_expected_photos_are_decoded_even_if_memory_cannot_hold_all_photos(log):
    sources = [Source(number, log) for number in range(3)]
    views, ahead = views_of(sources), PhotosAhead()
    with ahead.at_work(views, pytest.fail, keep=False):
        assert all_done(sources)
        sources[1].done.clear()
        ahead.expect([views[1]])
        assert sources[1].done.wait(SECONDS)
        assert ahead.useful
    assert sorted(log[:3]) == ["tried 0", "tried 1", "tried 2"] and log[3:] == [1]
    assert not ahead.useful


def test_at_most_twice_the_photo_memory_is_decoded_ahead(log):
    sources = [Source(number, log) for number in range(8)]
    views, ahead = views_of(sources, limit=6500), PhotosAhead()
    with ahead.at_work([], pytest.fail, keep=False):
        ahead.expect(views)
        assert all_done(sources[:3])
        Event().wait(0.05)
    assert sorted(log) == [0, 1, 2]


def test_an_error_in_decoding_ahead_is_raised_at_the_request(log):
    source = Source(1, log, error=OSError("broken"))
    (view,), ahead = views_of([source]), PhotosAhead()
    with ahead.at_work([], pytest.fail, keep=False):
        ahead.expect([view])
        assert source.done.wait(SECONDS)
    with pytest.raises(OSError, match="broken"):
        view.photo.image()


def test_a_photo_being_decoded_is_awaited_and_not_decoded_twice(log):
    gate = Event()
    source = Source(7, log, gate)
    (view,), ahead = views_of([source]), PhotosAhead()
    with ahead.at_work([], pytest.fail, keep=False):
        ahead.expect([view])
        while not log:
            gate.wait(0.01)
        gate.set()
        assert view.photo.image()[0] == 7
    assert log == [7]


def test_a_blocked_decoding_thread_is_not_awaited(log, monkeypatch):
    monkeypatch.setattr(photos, "_PATIENCE", 0.05)
    gate = Event()
    source = Source(7, log, gate)
    (view,), ahead = views_of([source]), PhotosAhead()
    with ahead.at_work([], pytest.fail, keep=False):
        ahead.expect([view])
        while not log:
            gate.wait(0.01)
        source.gate = None
        image = view.photo.image()
        assert log == [7, 7] and not gate.is_set()
        gate.set()
    assert view.photo.image() is image and view.photo.cache.used == 1000


def test_expected_photos_are_dropped_last(log):
    sources = [Source(number, log) for number in range(40)]
    views = views_of(sources, limit=5500)
    cache = views[0].photo.cache
    for view in views[:4]:
        view.photo.image()
    cache.expect(sources[:2])
    for view in views[4:40]:
        view.photo.image()
    assert cache.used <= 5500
    assert cache.holds(sources[0]) and cache.holds(sources[1]) and not cache.holds(sources[2])


def test_cpu_time_of_decoding_ahead_is_reported_separately(log):
    class Busy(Source):
        def decode(self):
            while self.spent() < 0.05:
                pass
            return super().decode()

        def spent(self):
            from time import thread_time

            return thread_time()

    source = Busy(1, log)
    (view,), ahead = views_of([source]), PhotosAhead()
    with ahead.at_work([], pytest.fail, keep=False):
        ahead.expect([view])
        assert source.done.wait(SECONDS)
    assert ahead.taken_cpu() >= 0.04
    assert ahead.taken_cpu() == 0.0
