"""Small photos are asked for fainter features; nobody's features are asked for twice."""

import json

import pytest

from crossgrad_plugins.prepare import features
from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.plan import Photo, Plan, Settings


def photo(name, width, height):
    return Photo(
        name=name, folder="", width=width, height=height, orientation=1, camera="a",
        position=None, mask=None, brightness=100.0, sharpness=300.0, bytes=1, sha256="0" * 64,
    )  # fmt: skip


@pytest.fixture
def asked(tmp_path, monkeypatch):
    calls = []

    def found(photos, **settings):
        layout = Layout(tmp_path / "scene")
        layout.work.mkdir(parents=True, exist_ok=True)
        layout.database.touch()
        layout.features.unlink(missing_ok=True)
        plan = Plan(photos=str(tmp_path), settings=Settings(**settings), used=photos, left_out=())
        counts = features.found_features(layout, plan, 1)
        assert counts == json.loads(layout.features.read_text())
        made, calls[:] = list(calls), []
        return made

    def find(layout, plan, names, options):
        calls.append((names, options.sift.peak_threshold, options.sift.edge_threshold))

    monkeypatch.setattr(features, "_find", find)
    monkeypatch.setattr(features, "_counts", lambda _: {"large.jpg": 5, "small.jpg": 5})
    return found


def test_small_photos_use_a_lower_feature_threshold(asked):
    large, small = photo("large.jpg", 1600, 1200), photo("small.jpg", 640, 400)
    usual = pytest.approx((0.02 / 3, 10.0))
    (first, second) = asked((large, small))
    assert first[0] == ["large.jpg"] and first[1:] == usual
    assert second == (["small.jpg"], 0.002, 20.0)
    assert [names for names, *_ in asked((large,))] == [["large.jpg"]]
    # What counts is the size that is looked at.
    ((names, *thresholds),) = asked((large, small), max_size=800)
    assert names == ["large.jpg", "small.jpg"] and thresholds == [0.002, 20.0]
