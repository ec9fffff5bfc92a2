"""Photos kept on disk: the same bits as decoded ones, whatever happened to the files."""

import os
import shutil
import threading
import zlib
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from crossgrad_core.scene.photos import photo_store
from crossgrad_core.scene.photos.photo_store import PhotoStore, store_folder
from crossgrad_core.scene.photos.photos import PhotoCache

WIDTH, HEIGHT = 40, 30
BYTES = 12 + 3 * WIDTH * HEIGHT
MASKED_BYTES = BYTES + WIDTH * HEIGHT // 8


@dataclass(frozen=True)
class Large:
    """Stands in for a source whose decoding is dear; counts how often it is decoded."""

    seed: int
    masked: bool = True
    origin: str | None = "a file"
    target: tuple[int, int] = (WIDTH, HEIGHT)
    decoded: list[int] = field(default_factory=list, compare=False)

    def decode(self):
        self.decoded.append(1)
        rng = np.random.default_rng(self.seed)
        image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        mask = torch.from_numpy(rng.random((HEIGHT, WIDTH)) < 0.5) if self.masked else None
        return torch.from_numpy(image), mask


def large(seed, **changes):
    return Large(seed, **{"origin": f"file {seed}", **changes})


def same(one, other):
    return all(
        a is b if a is None or b is None else torch.equal(a, b)
        for a, b in zip(one, other, strict=True)
    )


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "cache" / "photos"


@pytest.fixture
def store(folder):
    return PhotoStore(folder, 16)


def files(folder):
    return sorted(folder.iterdir())


@pytest.mark.parametrize("masked", [False, True])
def test_a_photo_is_decoded_once_for_all_runs(folder, masked):
    source = large(1, masked=masked)
    whole = source.decode()
    for _ in range(3):
        assert same(PhotoStore(folder, 16).decoded(source), whole)
    assert len(source.decoded) == 2
    (entry,) = files(folder)
    assert entry.stat().st_size == (MASKED_BYTES if masked else BYTES)


def test_photos_that_decode_quickly_are_not_stored(store, folder):
    source = large(1, origin=None)
    assert store.holds(source) is None
    store.decoded(source)
    assert not folder.exists()


def test_a_changed_origin_counts_as_another_photo(store, folder):
    for number in range(4):
        source = large(1, origin=f"size {number}")
        assert store.holds(source) is False
        store.decoded(source)
        assert store.holds(source) is True
    assert len(files(folder)) == 4


def test_a_damaged_entry_is_not_used(store, folder):
    """After any changed byte or length, the photo is decoded and stored again."""
    source, rng = large(3), np.random.default_rng(0)
    whole = store.decoded(source)
    (entry,) = files(folder)
    good = entry.read_bytes()
    for _ in range(60):
        bad = bytearray(good)
        match rng.integers(4):
            case 0:
                bad[rng.integers(len(bad))] ^= 1 << int(rng.integers(8))
            case 1:
                del bad[int(rng.integers(len(bad))) :]
            case 2:
                bad += bytes(int(rng.integers(1, 2000)))
            case 3:
                bad[: BYTES - 200] = bytes(BYTES - 200)
        entry.write_bytes(bad)
        before = len(source.decoded)
        assert same(store.decoded(source), whole)
        assert len(source.decoded) == before + 1
        assert entry.read_bytes() == good


def test_the_checksum_of_an_entry_is_verified_only_after_another_store_used_it(
    store, folder, monkeypatch
):
    source, sums = large(3), []
    whole = store.decoded(source)
    monkeypatch.setattr(photo_store, "crc32", lambda data: sums.append(0) or zlib.crc32(data))
    assert same(store.decoded(source), whole) and same(store.decoded(source), whole)
    assert not sums
    assert same(PhotoStore(folder, 1).decoded(source), whole)
    assert len(sums) == 1
    assert same(store.decoded(source), whole) and same(store.decoded(source), whole)
    assert len(sums) == 2


def test_an_entry_of_another_size_is_not_used(store, folder):
    store.decoded(large(1))
    other = large(1, target=(HEIGHT - 1, WIDTH))
    store.decoded(other)
    assert len(other.decoded) == 1


def test_unused_entries_are_evicted_first_and_used_entries_are_kept(folder):
    store = PhotoStore(folder, 1)
    store._limit = 4 * MASKED_BYTES
    for number in range(4):
        store.decoded(large(number))
    old = {path: os.stat(path).st_mtime for path in files(folder)}
    for age, path in enumerate(sorted(old, key=old.get)):
        os.utime(path, (1000.0 + age, 1000.0 + age))
    later = PhotoStore(folder, 1)
    later._limit = 4 * MASKED_BYTES
    later.decoded(large(0))  # The oldest, but in use from now on.
    for number in (10, 11, 12):
        later.decoded(large(number))
    assert [later.holds(large(n)) for n in (0, 1, 2, 3)] == [True, False, False, False]
    # All of them are in use now: the next ones are decoded each time.
    unkept = large(13)
    assert same(later.decoded(unkept), later.decoded(unkept))
    assert len(files(folder)) == 4 and later.holds(unkept) is None
    again = large(0)
    assert same(later.decoded(again), large(0).decode()) and not again.decoded


def test_temporary_files_of_killed_processes_are_deleted(store, folder):
    folder.mkdir(parents=True)
    old, new = folder / "a.1.0.tmp", folder / "b.1.0.tmp"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    store.decoded(large(1))
    assert not old.exists() and new.exists()


def full(*_args, **_kwargs):
    raise OSError(28, "No space left on device")


def no_rights(*_args, **_kwargs):
    raise PermissionError(13, "Permission denied")


@pytest.mark.parametrize("error", [full, no_rights])
@pytest.mark.parametrize("where", ["mkdir", "open", "replace"])
def test_a_disk_without_write_access_causes_no_error(store, folder, monkeypatch, error, where):
    source = large(1)
    with monkeypatch.context() as patch:
        if where == "open":
            patch.setattr("pathlib.Path.open", error)
        else:
            patch.setattr(f"pathlib.Path.{where}", error)
        assert same(store.decoded(source), source.decode())
    assert not folder.exists() or not files(folder)
    store.decoded(large(2))  # Not tried again in this run.
    assert not folder.exists() or not files(folder)


def test_a_reserve_of_free_disk_space_is_kept(store, folder, monkeypatch):
    usage = shutil.disk_usage(folder.anchor)
    monkeypatch.setattr(
        photo_store.shutil, "disk_usage", lambda _: usage._replace(free=photo_store.RESERVE + 10)
    )
    store.decoded(large(1))
    assert files(folder) == []


def test_threads_and_runs_can_share_a_folder(folder):
    stores = [PhotoStore(folder, 16) for _ in range(3)]
    sources = [large(number) for number in range(12)]
    wanted = [source.decode() for source in sources]
    wrong = []

    def work(store, seed):
        for number in np.random.default_rng(seed).integers(0, 12, 60):
            good = same(store.decoded(sources[number]), wanted[number])
            wrong.extend([] if good else [number])

    threads = [
        threading.Thread(target=work, args=(store, seed)) for seed, store in enumerate(stores * 2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert len(files(folder)) == 12 and all(path.suffix == ".photo" for path in files(folder))


def test_memory_is_used_before_the_disk_and_the_disk_before_the_file(store):
    source, cache = large(1), PhotoCache(16, store)
    assert cache.prepare(source) and cache.prepare(source)
    assert cache.used == 0 and len(source.decoded) == 1
    first = cache.get(source)
    assert cache.get(source) is first and len(source.decoded) == 1
    assert not PhotoCache(16).prepare(source)
    assert not PhotoCache(16, store).prepare(large(1, origin=None))


@pytest.mark.parametrize(
    ("variables", "place"),
    [
        ({"CROSSGRAD_CACHE": "/a"}, "/a/photos"),
        ({"XDG_CACHE_HOME": "/b"}, "/b/crossgrad/photos"),
    ],
)
def test_the_cache_folder_belongs_to_the_user(monkeypatch, variables, place):
    monkeypatch.delenv("CROSSGRAD_CACHE", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert store_folder().as_posix() == place
