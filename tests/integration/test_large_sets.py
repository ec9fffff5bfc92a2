"""Sets that do not fit into memory train to the same bits, wherever their photos come from."""

import pytest
from support.same_bits import bits
from support.scenes import write_tiny_scene

from crossgrad_core.run import app, finish
from crossgrad_core.scene.photos import photos


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photos that are undistorted and made smaller."""
    folder = tmp_path_factory.mktemp("large") / "tiny"
    return write_tiny_scene(folder, views=12, width=96, height=64, model="OPENCV", suffix=".jpg")


def trained(scene, out, *, check=False, **reading):
    settings = {
        "scene": str(scene),
        "steps": 14,
        "views_per_step": 2,
        "data": {"max_size": 48, **reading},
        "out": str(out),
    }
    assert app.run(settings, check=check, verbosity=-1) == 0
    return bits(out)


@pytest.mark.slow
def test_photos_from_memory_disk_cache_and_files_give_the_same_bits(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("CROSSGRAD_CACHE", str(tmp_path / "cache"))
    in_memory = trained(scene, tmp_path / "in memory")
    assert not (tmp_path / "cache").exists()

    # As if photos were large, and there were memory for one of them.
    monkeypatch.setattr(photos, "_LARGE", 1)
    for module in (app, finish):
        monkeypatch.setattr(module, "fits", lambda *_: False)
    monkeypatch.setattr(photos, "_LATEST", 2)
    begun = photos.PhotoCache.__init__

    def small(cache, _mib, store=None):
        begun(cache, 0, store)
        cache.limit = 4 * 48 * 32

    monkeypatch.setattr(photos.PhotoCache, "__init__", small)
    assert trained(scene, tmp_path / "from files", disk_mib=0) == in_memory
    assert not (tmp_path / "cache").exists()
    assert trained(scene, tmp_path / "to the disk", check=True) == in_memory
    assert len(list((tmp_path / "cache" / "photos").glob("*.photo"))) == 12

    def refuse(*_):
        raise AssertionError("decoded again")

    monkeypatch.setattr(photos, "decode_photo", refuse)
    monkeypatch.setattr(photos.PhotoSource, "try_out", lambda _: None)
    assert trained(scene, tmp_path / "from the disk") == in_memory
