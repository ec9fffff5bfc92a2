"""Fitting, planting and opening levels of detail against the published formulas."""

import math

import numpy as np
import pytest
import torch

from crossgrad_backbones.levels.lattice import (
    MOST_LEVELS,
    Lattice,
    automatic_root_cell,
    bounding_range,
    distance_range,
    number_of_levels,
    resolvable_levels,
    root_above,
    root_cell,
)
from crossgrad_backbones.octree import allowed_top, init_anchors, opening_steps, visible_share


def quantile(values, q):
    """Linear interpolation between order statistics, from the definition."""
    values = sorted(values)
    place = q * (len(values) - 1)
    low = math.floor(place)
    high = min(low + 1, len(values) - 1)
    return values[low] + (place - low) * (values[high] - values[low])


def test_the_distance_range_is_a_quantile_of_quantiles():
    rng = np.random.default_rng(0)
    points, centers = rng.normal(size=(300, 3)), rng.uniform(-5, 5, (9, 3))
    pooled = []
    for center in centers.tolist():
        distances = [math.dist(point, center) for point in points.tolist()]
        pooled += [quantile(distances, 0.01), quantile(distances, 0.99)]
    largest, smallest = distance_range(points, centers, 0.99)
    assert largest == pytest.approx(quantile(pooled, 0.99), rel=1e-12)
    assert smallest == pytest.approx(quantile(pooled, 0.01), rel=1e-12)


@pytest.mark.parametrize(
    ("points", "centers", "largest", "levels"),
    [
        ([[0, 0, 0]], [[0, 0, 3]], 3.0, 1),  # one distance
        ([[0, 0, 0]], [[0, 0, 0]], 1.0, MOST_LEVELS),  # a camera on the only point
        ([[0, 0, 0]], [[0, 0, 8], [0, 0, 1]], 8.0, 4),
        ([[0, 0, 0], [0, 0, 1e-30]], [[0, 0, 0], [0, 5, 0]], 5.0, MOST_LEVELS),
    ],
)
def test_the_number_of_levels_is_defined_for_degenerate_distances(points, centers, largest, levels):
    found, smallest = distance_range(np.array(points, float), np.array(centers, float), 1.0)
    assert found == pytest.approx(largest) and smallest > 0.0
    assert number_of_levels(found, smallest, 2) == levels


@pytest.mark.parametrize(
    ("ratio", "fork", "levels"), [(1, 2, 1), (8, 2, 4), (11, 2, 4), (12, 2, 5), (27, 3, 4)]
)
def test_the_number_of_levels_follows_from_the_distance_ratio(ratio, fork, levels):
    assert number_of_levels(5.0 * ratio, 5.0, fork) == levels


def test_the_bounding_range_is_one_interval_for_the_coordinates_of_all_axes():
    points = np.array([[-2.0, 0.0, 1.0], [0.5, 3.0, -1.0]])
    assert bounding_range(points) == pytest.approx((-2.2, 5.5))
    assert bounding_range(np.ones((4, 3)))[1] == 0.0


@pytest.mark.parametrize("edge", [0.3, 2.71, 16.77, 1e6])
@pytest.mark.parametrize("levels", [1, 2, 4, 7])
@pytest.mark.parametrize("fork", [2, 3])
def test_the_level_below_the_middle_has_about_the_requested_cell_size(edge, levels, fork):
    cell = root_cell(edge, -1, root_above(0.02, levels, fork))
    halvings = math.log2(edge / cell)
    assert halvings == pytest.approx(round(halvings), abs=1e-9)
    below_the_middle = cell / float(fork) ** (levels // 2 - 1)
    assert below_the_middle * (1 + 1e-9) >= 0.02 / 2**0.5
    assert below_the_middle <= 0.02 * 2**0.5 * (1 + 1e-9)


def test_the_automatic_root_cell_is_four_distances_between_points():
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.4, 0, 0], [0.7, 0, 0], [1.9, 0, 0]])
    # To their nearest neighbours: 0.1, 0.1, 0.3, 0.3, 1.2.
    assert automatic_root_cell(points) == pytest.approx(4 * 0.3)
    assert automatic_root_cell(points[:1]) > 0.0


def test_the_root_cell_follows_the_given_layer_and_has_a_default_for_a_single_point():
    assert root_cell(8.0, 10, 0.02) == 8.0 / 1024
    assert root_cell(0.0, -1, 0.02) == root_cell(0.0, 10, 0.02) == 0.02


def lattice(levels, origin=0.0, share=0.0):
    numbers = [origin] * 3 + [0.5, 2, levels, 4.0, 0.5, share]
    return Lattice.of(torch.tensor(numbers, dtype=torch.float64))


def sites_by_loops(points, levels, origin, everywhere):
    """(level, x, y, z) of the sites, from the definition."""
    site = {
        (level, i): (level, *(round((x - origin) / (0.5 / 2**level)) for x in point))
        for level in range(levels)
        for i, point in enumerate(points.tolist())
    }
    wanted = set()
    for (level, i), own in site.items():
        together = [
            site[level, j]
            for j in range(len(points))
            if level > 0 and site[level - 1, j] == site[level - 1, i]
        ]
        if level == 0 or everywhere or any(other != own for other in together):
            wanted.add(own)
    return wanted


@pytest.mark.parametrize("everywhere", [False, True])
def test_initial_anchors_round_points_to_each_level_without_duplicates(everywhere):
    points = np.random.default_rng(3).uniform(-1, 1, (60, 3))
    anchors = init_anchors(points, lattice(4, origin=-1.1), everywhere=everywhere)
    positions, levels = anchors.positions, anchors.levels
    expected = sites_by_loops(points, 4, -1.1, everywhere)
    found = [
        (level, *(round((x + 1.1) / (0.5 / 2**level)) for x in position))
        for level, position in zip(levels.tolist(), positions.tolist(), strict=True)
    ]
    assert len(found) == len(expected) and set(found) == expected
    assert (len(found) == len(sites_by_loops(points, 4, -1.1, True))) == everywhere
    assert levels.tolist() == sorted(levels.tolist())


@pytest.mark.parametrize(("everywhere", "wanted"), [(False, [0]), (True, [0, 1, 2])])
def test_one_point_has_anchors_on_finer_levels_only_with_plant_everywhere(everywhere, wanted):
    anchors = init_anchors(np.array([[0.1, 0.2, 0.3]]), lattice(3), everywhere=everywhere)
    assert anchors.levels.tolist() == wanted
    assert anchors.positions[0].tolist() == [0.0, 0.0, 0.5]


@pytest.mark.parametrize(
    ("x", "wanted"), [((0.1, 0.2), [0, 1, 1]), ((0.01, 0.05), [0, 3, 3]), ((0.1, 0.1), [0])]
)
def test_levels_that_separate_no_points_get_no_anchors(x, wanted):
    """The cells have sizes 1/2, 1/4, 1/8 and 1/16 around the origin."""
    points = np.array([[each, 0.0, 0.0] for each in x])
    assert init_anchors(points, lattice(4), everywhere=False).levels.tolist() == wanted


@pytest.mark.parametrize("everywhere", [False, True])
def test_initial_scales_use_all_sites_of_the_same_level(everywhere):
    points = np.random.default_rng(4).uniform(-1, 1, (60, 3))
    anchors = init_anchors(points, lattice(4), everywhere=everywhere)
    assert anchors.levels.max() == 3
    sites = init_anchors(points, lattice(4), everywhere=True)
    for position, level, found in zip(*(t.tolist() for t in vars(anchors).values()), strict=True):
        same = sites.positions[sites.levels == level].tolist()
        nearest = sorted(math.dist(position, other) ** 2 for other in same)[1:4]
        assert found == pytest.approx(math.sqrt(sum(nearest) / 3))


@pytest.mark.parametrize("fork", [2, 3])
@pytest.mark.parametrize("reach", [0.5, 12.0, 1e4])
def test_float32_distinguishes_the_cells_of_the_finest_level(fork, reach):
    levels = resolvable_levels(16, fork, 1e-3, reach)
    cell = 1e-3 / fork ** (levels - 1)
    if levels > 1:
        places = np.arange(1, 1001) * cell + (reach - 1001 * cell)
        found = np.round((places.astype(np.float32).astype(float) - places[0]) / cell)
        assert found.tolist() == list(range(1000))
        assert cell / fork < 2.0**-20 * reach or levels == 16
    assert resolvable_levels(3, fork, 0.5, 1.0) == 3
    assert resolvable_levels(3, fork, 0.5, 0.0) == 3


def test_the_automatic_threshold_is_the_mean_of_the_visible_shares():
    shares = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    assert visible_share(shares, -1.0) == 0.5
    assert visible_share(shares, 0.01) == 0.01


def test_level_openings_follow_a_geometric_series_that_ends_on_time():
    openings = opening_steps(10_000.0, 3, 1.5)
    q = 1 / 1.5
    first = 10_000 * (1 - q) / (1 - q**3)
    assert openings == pytest.approx([first, first * (1 + q), first * (1 + q + q * q)])
    assert openings[-1] == pytest.approx(10_000)


@pytest.mark.parametrize(
    ("step", "top"), [(0, 2), (4736, 2), (4737, 3), (7894, 3), (7895, 4), (9_999, 4), (10_000, 5)]
)
def test_levels_open_one_by_one(step, top):
    assert allowed_top(step, (4736.84, 7894.74, 10_000.0), 2) == top


def test_level_openings_work_with_ratio_one_and_without_levels():
    assert opening_steps(9.0, 3, 1.0) == pytest.approx((3.0, 6.0, 9.0))
    assert opening_steps(9.0, 0, 1.5) == ()
    assert allowed_top(0, (), 0) == 0
