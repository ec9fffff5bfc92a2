"""Nested lattices against the published formulas, worked out anchor by anchor."""

import math

import numpy as np
import pytest
import torch

from crossgrad_backbones.levels.lattice import Lattice

ROUNDING = {"floor": (0.0, math.floor), "round": (0.5, round), "ceil": (1.0, math.ceil)}


def lattice(*, fork=2, levels=5, distance=4.0, lead=0.5, share=0.3, origin=(-1.1, -1.1, -1.1)):
    scalars = (0.5, fork, levels, distance, lead, share)
    return Lattice.of(torch.tensor([*origin, *scalars], dtype=torch.float64))


def cloud(rng, count=200, levels=5):
    anchors = torch.from_numpy(rng.uniform(-3, 3, (count, 3)))
    return anchors, torch.from_numpy(rng.integers(0, levels, count))


def test_packing_a_lattice_keeps_every_number():
    one = lattice()
    assert Lattice.of(one.packed()).packed().tolist() == one.packed().tolist()
    assert one.packed().dtype == torch.float64 and one.count == 5


@pytest.mark.parametrize("fork", [2, 3])
def test_cells_of_each_finer_level_are_smaller_by_the_factor_fork(fork):
    cells = lattice(fork=fork).cells(torch.arange(5))
    assert cells.tolist() == pytest.approx([0.5 / fork**level for level in range(5)], rel=1e-15)


def test_lattice_sites_are_nearest_to_their_points_and_recovered_from_their_positions():
    rng = np.random.default_rng(0)
    points, levels = cloud(rng)
    grid = lattice()
    sites = grid.coordinates(points, levels).round().long()
    for point, level, site in zip(points.tolist(), levels.tolist(), sites.tolist(), strict=True):
        cell = 0.5 / 2**level
        assert site == [round((x + 1.1) / cell) for x in point]
    positions = grid.positions(sites, levels)
    again = grid.coordinates(positions.float(), levels)
    assert torch.equal(again.round().long(), sites)
    assert float((positions - points).abs().max()) <= 0.25


@pytest.mark.parametrize("fork", [2, 3])
@pytest.mark.parametrize("rounding", ROUNDING)
def test_an_anchor_is_visible_if_its_level_is_at_most_the_rounded_level(rounding, fork):
    rng = np.random.default_rng(1)
    anchors, levels = cloud(rng)
    extra = torch.from_numpy(rng.uniform(0, 0.6, len(levels)))
    lead, whole = ROUNDING[rounding]
    grid = lattice(fork=fork, lead=lead)
    camera = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    distances = grid.distances(anchors, levels, camera)
    seen = grid.seen(distances, levels, extra)
    detail = grid.detail(distances, extra)
    for i, level in enumerate(levels.tolist()):
        half = 0.5 * 0.5 / fork**level
        distance = math.dist([x + half for x in anchors[i].tolist()], camera.tolist())
        value = math.log(4.0 / distance, fork) + float(extra[i])
        assert float(distances[i]) == pytest.approx(distance, rel=1e-12)
        assert float(detail[i]) == pytest.approx(value, rel=1e-9, abs=1e-9)
        assert bool(seen[i]) == (level <= min(max(whole(value), 0), 4))
    assert 0 < int(seen.sum()) < len(seen)


def test_level_0_is_always_visible_and_a_camera_inside_an_anchor_sees_every_level():
    grid, camera = lattice(lead=0.0), torch.zeros(3)
    levels = torch.arange(5)
    far = torch.full((5,), 1e30)
    none = torch.zeros(5)
    assert grid.seen(far, levels, none).tolist() == [True, False, False, False, False]
    inside = torch.stack([-0.5 * grid.cells(levels).float()] * 3, 1)
    distances = grid.distances(inside, levels, camera)
    assert float(distances.max()) < 1e-6 and grid.seen(distances * 0, levels, none).all()
    assert not grid.detail(distances * 0, none).isnan().any()


def test_the_visible_share_of_an_anchor_is_the_share_of_cameras_that_see_it():
    rng = np.random.default_rng(2)
    anchors, levels = cloud(rng, 30)
    cameras = torch.from_numpy(rng.uniform(-6, 6, (7, 3)))
    grid = lattice()
    shares = grid.shares(anchors, levels, cameras)
    for i, level in enumerate(levels.tolist()):
        half = 0.25 / 2**level
        corner = [x + half for x in anchors[i].tolist()]
        details = [math.log2(4.0 / math.dist(corner, camera)) for camera in cameras.tolist()]
        assert float(shares[i]) == pytest.approx(
            sum(level <= max(round(d), 0) for d in details) / 7
        )


def test_keep_levels_drops_low_shares_and_never_a_share_of_one():
    grid = lattice(share=0.5)
    shares = torch.tensor([0.0, 0.5, 0.51, 1.0], dtype=torch.float64)
    assert grid.keep_levels(shares).tolist() == [False, False, True, True]
    everyone = lattice(share=1.0)
    assert everyone.keep_levels(shares).tolist() == [False, False, False, True]


def test_visible_shares_without_cameras_are_zero():
    anchors, levels = torch.zeros(2, 3), torch.tensor([0, 1])
    assert lattice().shares(anchors, levels, torch.zeros(0, 3)).tolist() == [0.0, 0.0]
