"""Conclusions of the report: missing bridges, and the reasons why photos were lost."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crossgrad_plugins.prepare.findings import (
    bridges_of,
    fallbacks,
    joins_of,
    lost_photos,
    parts_of,
)
from crossgrad_plugins.prepare.matching import Link
from crossgrad_plugins.prepare.plan import Photo, Plan, Settings


def photo(name, **changed):
    plain = {
        "name": name, "folder": name.rpartition("/")[0], "width": 100, "height": 80,
        "orientation": 1, "camera": "", "position": None, "mask": None, "brightness": 120.0,
        "sharpness": 50.0, "bytes": 1, "sha256": name,
    }  # fmt: skip
    return Photo(**{**plain, **changed})


def plan_of(*photos):
    return Plan(photos="photos", settings=Settings(), used=photos, left_out=())


AERIAL = [f"aerial/{n}" for n in range(4)]
STREET = [f"street/{n}" for n in range(3)]
PLAN = plan_of(*map(photo, AERIAL + STREET))
MODELS = [frozenset(AERIAL), frozenset(STREET)]


def test_the_advice_for_two_models_at_different_heights_is_a_flight_between_the_heights():
    heights = dict.fromkeys(AERIAL, 40.0) | dict.fromkeys(STREET, 5.0)
    (bridge,) = bridges_of(PLAN, [], parts_of(PLAN, MODELS), heights)
    assert "fly from 5 to 40 m here" in bridge.advice
    assert (bridge.first, bridge.second, bridge.photos) == ("aerial", "street", 3)
    assert bridge.heights == (5.0, 40.0)


def test_a_bridge_without_known_heights_is_reported_in_ratios():
    (bridge,) = bridges_of(PLAN, [], parts_of(PLAN, MODELS), {})
    assert "between aerial and street" in bridge.advice
    assert bridge.heights is None


def test_the_advice_for_two_models_at_similar_heights_is_overlap():
    heights = dict.fromkeys(AERIAL, 12.0) | dict.fromkeys(STREET, 10.0)
    (bridge,) = bridges_of(PLAN, [], parts_of(PLAN, MODELS), heights)
    assert "overlap with both" in bridge.advice


def test_one_bridge_covers_all_pieces_of_a_folder():
    pieces = [frozenset(AERIAL), frozenset(STREET[:1]), frozenset(STREET[1:])]
    (bridge,) = bridges_of(PLAN, [], parts_of(PLAN, pieces), {})
    assert bridge.photos == 3


def test_a_folder_split_into_several_models_is_reported():
    pieces = [frozenset(AERIAL[:2]), frozenset(AERIAL[2:])]
    (bridge,) = bridges_of(plan_of(*map(photo, AERIAL)), [], pieces, {})
    assert "aerial: the photos form separate parts" in bridge.advice


def test_a_folder_without_a_model_needs_a_bridge_and_a_complete_model_needs_none():
    (bridge,) = bridges_of(PLAN, [], parts_of(PLAN, MODELS[:1]), {})
    assert bridge.second == "street"
    assert not bridges_of(PLAN, [], parts_of(PLAN, [frozenset(AERIAL + STREET)]), {})
    assert not bridges_of(PLAN, [], [], {})


def test_image_pairs_between_folders_are_counted():
    links = [Link("aerial/0", "street/1", 20), Link("aerial/0", "aerial/1", 300)]
    (bridge,) = bridges_of(PLAN, links, parts_of(PLAN, MODELS), {})
    assert bridge.pairs == 1
    joins = {
        (join.first, join.second): (join.pairs, join.matches) for join in joins_of(PLAN, links)
    }
    assert joins == {
        ("aerial", "aerial"): (1, 300),
        ("street", "street"): (0, 0),
        ("aerial", "street"): (1, 20),
    }


@given(st.floats(1.0, 50.0), st.floats(1.5, 60.0))
def test_intermediate_heights_span_the_range_in_equal_factors(low, factor):
    found = fallbacks(low, low * factor)
    assert found[0] == pytest.approx(low)
    assert found[-1] == pytest.approx(low * factor)
    steps = [after / before for before, after in itertools.pairwise(found)]
    assert max(steps) <= 1.4 + 1e-9 or len(steps) == 12
    assert max(steps) == pytest.approx(min(steps))


@pytest.mark.parametrize(
    ("changed", "features", "links", "why"),
    [
        ({"brightness": 5.0}, 900, 2, "dark"),
        ({"brightness": 250.0}, 900, 2, "overexposed"),
        ({"sharpness": 1.0}, 900, 2, "blurred"),
        ({}, 30, 0, "few features (30"),
        ({}, 0, 0, "no feature"),
        ({}, 900, 0, "no verified matches"),
        ({}, 900, 2, "matches with 2 photos"),
    ],
)
def test_the_reason_why_a_photo_is_lost_is_reported(changed, features, links, why):
    bad = photo("bad", **changed)
    plan = plan_of(*map(photo, AERIAL), bad)
    found = [Link("bad", name, 20) for name in AERIAL[:links]]
    counts = dict.fromkeys(AERIAL, 1000) | {"bad": features}
    (lost,) = lost_photos(plan, counts, found, [(frozenset(AERIAL), True)], {})
    assert lost.name == "bad"
    assert why in lost.why


def test_a_photo_of_another_model_is_reported_so():
    counts = dict.fromkeys(AERIAL + STREET, 1000)
    lost = lost_photos(PLAN, counts, [], list(zip(MODELS, [True, False], strict=True)), {})
    assert [each.name for each in lost] == STREET
    assert {each.why for each in lost} == {"it belongs to another model, of 3 photos"}
    assert not lost_photos(PLAN, counts, [], list(zip(MODELS, [True, True], strict=True)), {})


def test_a_removed_photo_is_reported_with_the_reason():
    counts = dict.fromkeys(AERIAL + STREET, 1000)
    models = [(frozenset(AERIAL + STREET[1:]), True)]
    (lost,) = lost_photos(PLAN, counts, [], models, {STREET[0]: (40, 310)})
    assert lost.name == STREET[0]
    assert "40 support its best position and 310 contradict it" in lost.why
