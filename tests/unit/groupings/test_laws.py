"""Properties of every grouping, and the result of each grouping on a scene made for it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import radial_distances
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.groupings.distance import Anchors, Percentile, Radial, Terciles
from crossgrad_plugins.groupings.gmm import GaussianMixture
from crossgrad_plugins.groupings.kmeans import KMeans

BY_POSITION = (
    "altitude",
    "anchors",
    "footprint",
    "gmm",
    "kmeans",
    "percentile",
    "radial",
    "terciles",
)


class AgreementProbe:
    """Gradients of street cameras along one axis and of aerial ones along another."""

    def __init__(self, sides):
        self.blocks = ("means",)
        self.sides = np.array(sides)

    def gramians(self, views):
        sides = self.sides[list(views)]
        return np.where(sides[:, None] == sides[None, :], 1.0, -0.2)[None] + 0.5 * np.eye(
            len(sides)
        )


def hybrid(street=12, aerial=9, scale=1.0, test=(0, 20)):
    """A street ring at height 1 and an aerial ring at height 8 that look at the origin."""
    views = []
    for count, radius, height, folder in ((street, 3.0, 1.0, "street"), (aerial, 9.0, 8.0, "air")):
        for i in range(count):
            angle = 2 * np.pi * (i + 0.3 * (i % 3)) / count
            center = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
            center[2] += 0.05 * i
            view = posed_view(center * scale, f"{folder}/{i:02}.png", forward=-center, focal=40.0)
            views.append(view)
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.5 * scale
    return posed_scene(views, points, test=test)


def label(name, scene, views=None, seed=0, **options):
    probe = AgreementProbe(["street" not in view.name for view in scene.train_views])
    grouping = build("groupings", name, options)
    views = scene.train_views if views is None else views
    return grouping.fit(scene, np.random.default_rng(seed), probe).labels(views)


@pytest.mark.parametrize("name", entries("groupings"))
def test_labels_are_declared_and_no_required_group_is_empty(name):
    scene = hybrid()
    labels = label(name, scene)
    declared = build("groupings", name, {}).labels
    assert len(labels) == len(scene.train)
    assert set(labels) == set(declared or ("street", "air"))


@pytest.mark.parametrize("name", entries("groupings"))
def test_a_grouping_is_fitted_on_training_cameras_and_applied_to_all_cameras(name):
    scene = hybrid()
    every = label(name, scene, scene.views)
    assert tuple(every[i] for i in scene.train) == label(name, scene)
    moved = list(scene.views)
    moved[0] = posed_view((500.0, 0.0, 90.0), "street/00.png", forward=(-5, 0, -1))
    other = posed_scene(moved, scene.points, test=scene.test)
    assert label(name, other) == label(name, scene)


@pytest.mark.parametrize("name", entries("groupings"))
def test_the_unit_of_length_of_a_scene_does_not_change_the_labels(name):
    labels = label(name, hybrid())
    assert label(name, hybrid(scale=1e-3)) == labels
    assert label(name, hybrid(scale=1e4)) == labels


@pytest.mark.parametrize("name", ["altitude", "conflict-signature", "footprint", "gmm", "radial"])
def test_the_regimes_of_a_hybrid_scene_are_found(name):
    scene = hybrid(street=10, aerial=10, test=())
    expected = tuple("near" if "street" in view.name else "far" for view in scene.train_views)
    assert label(name, scene) == expected


@pytest.mark.parametrize("name", ["altitude", "conflict-signature", "gmm"])
def test_regimes_of_any_sizes_are_found(name):
    scene = hybrid(street=16, aerial=6, test=())
    expected = tuple("near" if "street" in view.name else "far" for view in scene.train_views)
    options = {"cut": "gap"} if name == "altitude" else {}
    assert label(name, scene, **options) == expected


@pytest.mark.parametrize("name", entries("groupings"))
@pytest.mark.parametrize("cameras", [1, 6])
def test_indistinguishable_cameras_are_a_user_error(name, cameras):
    views = [posed_view((1, 2, 3), f"{i}.png", forward=(0, 1, -1)) for i in range(cameras)]
    scene = posed_scene(views, [(1, 3, 2)])
    with pytest.raises(UserError) as error:
        label(name, scene)
    assert error.value.todo or "the same label" in error.value.what


@pytest.mark.parametrize("name", entries("groupings"))
def test_a_scene_without_training_views_is_a_user_error(name):
    scene = posed_scene([posed_view((0, 0, 1), "a/1.png")], test=[0])
    with pytest.raises(UserError, match="training views"):
        label(name, scene)


@pytest.mark.parametrize("name", BY_POSITION)
def test_the_fit_of_a_grouping_is_reported(name):
    scene = hybrid()
    rule = build("groupings", name, {}).fit(scene, np.random.default_rng(0))
    assert any(note.startswith(f"grouping {name}:") for note in rule.notes)


@pytest.mark.parametrize("name", ["gmm", "kmeans"])
def test_restarts_make_the_labels_of_a_grouping_independent_of_the_seed(name):
    rng = np.random.default_rng(2)
    centers = [*rng.normal(size=(12, 3)), *(rng.normal(size=(5, 3)) + np.array([0, 9, 20]))]
    scene = posed_scene([posed_view(p, f"{i:02}.png") for i, p in enumerate(centers)])
    labels = {label(name, scene, seed=seed) for seed in range(12)}
    assert labels == {("near",) * 12 + ("far",) * 5}


def on_a_line(*distances):
    """Cameras at these distances on either side of the origin, so that their mean is the origin."""
    views = [
        posed_view((side * r, 0, 0), f"{r}{side}.png") for r in distances for side in (1.0, -1.0)
    ]
    return posed_scene(views)


def test_the_radial_grouping_labels_ties_at_the_median_near():
    scene = on_a_line(1.0, 2.0, 2.0, 2.0, 5.0)
    labels = Radial().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels == ("near",) * 8 + ("far",) * 2


def test_the_radial_grouping_refuses_ties_that_leave_the_far_group_empty():
    scene = on_a_line(1.0, 2.0, 2.0, 2.0)
    with pytest.raises(UserError, match="near: 8, far: 0"):
        Radial().fit(scene, np.random.default_rng(0))


@pytest.mark.parametrize(("q", "near"), [(30.0, 6), (50.0, 10), (70.0, 14)])
def test_percentile_sets_the_share_of_near_cameras(q, near):
    scene = on_a_line(*np.linspace(1.0, 2.0, 10))
    labels = Percentile(q=q).fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels.count("near") == near


def test_terciles_have_equal_shares():
    scene = on_a_line(*np.linspace(1.0, 2.0, 9))
    labels = Terciles().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert [labels.count(name) for name in ("near", "middle", "far")] == [6, 6, 6]


def test_the_anchors_grouping_labels_thirty_percent_near_and_thirty_percent_far():
    scene = on_a_line(*np.linspace(1.0, 2.0, 10))
    labels = Anchors().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert [labels.count(name) for name in ("near", "middle", "far")] == [6, 8, 6]


def test_the_anchors_grouping_works_without_a_middle_group():
    scene = posed_scene([posed_view((0, 0, 0), "a.png"), posed_view((1, 0, 0), "b.png")])
    three = posed_scene([*scene.views, posed_view((5, 0, 0), "c.png")])
    labels = Anchors(share=0.5).fit(three, np.random.default_rng(0)).labels(three.views)
    assert set(labels) == {"near", "far"}


def test_the_kmeans_grouping_labels_the_inner_cluster_near():
    views = [posed_view((x, 0, 0), f"{x}.png") for x in (0.0, 0.1, 0.2, 0.3, 9.0)]
    scene = posed_scene(views)
    labels = KMeans().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels == ("near",) * 4 + ("far",)


def test_the_gmm_grouping_recovers_a_mixture():
    low = np.exp(norm.ppf((np.arange(30) + 0.5) / 30) * 0.2)
    high = np.exp(2.0 + norm.ppf((np.arange(15) + 0.5) / 15) * 0.1)
    scene = on_a_line(*low, *high)
    labels = GaussianMixture().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels == ("near",) * 60 + ("far",) * 30


@pytest.mark.parametrize(
    "distances",
    [
        pytest.param((1.0, 1.0, 1.0, 9.0), id="one component without spread"),
        pytest.param((0.0, 0.0, 1.0, 2.0), id="cameras at the mean"),
        pytest.param((1e-12, 1.0, 1.1, 1.2, 1.3), id="an outlier at the mean"),
    ],
)
def test_gmm_survives_degenerate_distances(distances):
    scene = on_a_line(*distances)
    rule = GaussianMixture().fit(scene, np.random.default_rng(0))
    assert set(rule.labels(scene.views)) == {"near", "far"}


def test_gmm_falls_back_to_the_median_with_a_note():
    # All that have a logarithm have one.
    scene = on_a_line(0.0, 0.0, 0.0, 1.0, 1.0)
    rule = GaussianMixture().fit(scene, np.random.default_rng(0))
    radial = Radial().fit(scene, np.random.default_rng(0))
    assert rule.labels(scene.views) == radial.labels(scene.views)
    assert "degenerate" in rule.notes[0]


def test_gmm_reports_no_degenerate_fit_for_a_normal_scene():
    scene = hybrid()
    rule = GaussianMixture().fit(scene, np.random.default_rng(0))
    assert not any("degenerate" in note for note in rule.notes)


def ring(radius, count, center, turn=0.0):
    """Cameras on a circle whose coordinates are no round numbers."""
    angles = turn + 2 * np.pi * np.arange(count) / count
    flat = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    return radius * flat + np.array(center)


def scene_at(*centers):
    rows = np.concatenate([np.atleast_2d(each) for each in centers])
    return posed_scene([posed_view(row, f"{i:02}.png") for i, row in enumerate(rows)])


@pytest.mark.parametrize(("name", "options"), [("radial", {"cut": "otsu"}), ("gmm", {})])
def test_a_camera_in_the_middle_of_two_rings_is_near_and_changes_no_cut(name, options):
    middle = (0.3, 0.7, 0.4)
    scene = scene_at(ring(1.0, 8, middle, 0.2), ring(3.0, 8, middle, 0.5), middle)
    rule = build("groupings", name, options).fit(scene, np.random.default_rng(0))
    assert rule.labels(scene.train_views) == ("near",) * 8 + ("far",) * 8 + ("near",)


@pytest.mark.parametrize("name", ["radial", "percentile", "anchors", "terciles"])
def test_cameras_on_one_ring_do_not_form_two_groups(name):
    scene = scene_at(ring(1.0, 12, (0.3, 0.7, 0.4), 0.2))
    with pytest.raises(UserError, match="left a group without training views"):
        build("groupings", name, {}).fit(scene, np.random.default_rng(0))


@pytest.mark.parametrize("cut", ["median", "otsu", "gap"])
def test_cameras_at_one_height_over_a_tilted_ground_do_not_form_two_groups(cut):
    up = np.array([0.1, -0.3, 0.9]) / np.linalg.norm([0.1, -0.3, 0.9])
    across = np.cross(up, [1.0, 0.0, 0.0])
    plane = np.stack([across, np.cross(up, across)])
    rows = np.random.default_rng(1).normal(size=(20, 2)) @ plane + 0.4
    grouping = build("groupings", "altitude", {"cut": cut, "up": tuple(up)})
    with pytest.raises(UserError, match="left a group without training views"):
        grouping.fit(scene_at(rows), np.random.default_rng(0))


def test_a_ring_in_large_coordinates_counts_as_one_ring():
    # Metres of a zone, whose rounding is that of millions.
    frame = Similarity(np.array([4.5e5, 5.6e6, 100.0]), 1 / 60)
    points = ring(60.0, 16, (4.5e5 + 11.3, 5.6e6 - 7.7, 120.1), 0.2)
    scene = replace(scene_at(frame.to_local(points)), similarity=frame)
    assert len(set(radial_distances(scene, scene.train_views))) == 1
    with pytest.raises(UserError, match="left a group without training views"):
        build("groupings", "radial", {}).fit(scene, np.random.default_rng(0))
