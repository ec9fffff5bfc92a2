"""Growth of an octree's anchors against the published rules, worked out offset by offset."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_backbones.anchors.growth.anchor_base import GrowthRequest
from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_backbones.levels.octree_control import (
    OctreeControl,
    Thresholds,
    grown,
    seen_from_farther,
)
from crossgrad_backbones.octree import Octree
from crossgrad_core.contract.blocks import (
    Edit,
    PluginState,
    apply_to_parameters,
    gather_indices,
    primitives_of,
)
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.renders import view_record

ORIGIN, ROOT, FORK, DISTANCE = -1.1, 0.5, 2, 4.0
THRESHOLDS = Thresholds(2e-4, 2**0.2)
NEAR_CAMERA = torch.tensor([[0.0, 0.0, 0.1]], dtype=torch.float64)


def parameters(rng, anchors=12, slots=3, levels=3, share=-1.0):
    """Anchors on the sites of random points, all at different sites."""
    numbers = [ORIGIN] * 3 + [ROOT, FORK, levels, DISTANCE, 0.5, share]
    packed = torch.tensor(numbers, dtype=torch.float64)
    level = torch.from_numpy(rng.integers(0, levels, anchors))
    sites = torch.from_numpy(np.stack([np.arange(anchors), *rng.integers(0, 4, (2, anchors))], 1))
    return {
        "anchors": Lattice.of(packed).positions(sites, level).float(),
        "offsets": torch.from_numpy(rng.normal(0, 1, (anchors, slots, 3))).float(),
        "features": torch.from_numpy(rng.normal(0, 1, (anchors, 5))).float(),
        "scales": torch.from_numpy(rng.normal(-1.5, 0.3, (anchors, 6))).float(),
        "levels": level,
        "extra_levels": torch.from_numpy(rng.uniform(0, 0.5, anchors)).float(),
        "lattice": packed,
    }


def request(rng, anchors=12, slots=3):
    gradient = torch.from_numpy(rng.uniform(0.5e-4, 4e-4, (anchors, slots))).float()
    return GrowthRequest(gradient, torch.from_numpy(rng.random((anchors, slots)) < 0.8))


def site(point, level):
    cell = ROOT / FORK**level
    return tuple(round((float(x) - ORIGIN) / cell) for x in point)


def slow_growth(tensors, asked, levels):
    """New anchors as {(level, site): (features, parents, strength)} by one loop over offsets."""
    held = {
        (level, site(x, level))
        for x, level in zip(tensors["anchors"], tensors["levels"].tolist(), strict=True)
    }
    found = {}
    for p, level in enumerate(tensors["levels"].tolist()):
        for slot in range(asked.gradient.shape[1]):
            gradient = float(asked.gradient[p, slot])
            threshold = 2e-4 * 2 ** (0.2 * level)
            if not bool(asked.eligible[p, slot]) or gradient < threshold:
                continue
            next_level = gradient >= threshold * 2**0.2 and level + 1 < levels
            stretch = tensors["scales"][p, :3].double().exp()
            mean = tensors["anchors"][p].double() + tensors["offsets"][p, slot].double() * stretch
            key = (level + next_level, site(mean, level + next_level))
            if key in held:
                continue
            features, parents, strengths = found.setdefault(key, ([], set(), []))
            if not next_level:
                features.append(tensors["features"][p])
            parents.add(p)
            strengths.append(gradient)
    return found


@pytest.mark.parametrize("levels", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(3))
def test_new_anchors_agree_with_a_loop_over_offsets(levels, seed):
    rng = np.random.default_rng(seed)
    tensors, asked = parameters(rng, 40, levels=levels), request(rng, 40)
    expected = slow_growth(tensors, asked, levels)
    new = grown(tensors, asked, THRESHOLDS, NEAR_CAMERA)
    at = new.further["levels"].tolist()
    keys = [(level, site(x, level)) for level, x in zip(at, new.positions, strict=True)]
    assert set(keys) == set(expected) and len(keys) == len(expected) > 3
    assert levels == 1 or len(set(at)) > 1
    for i, key in enumerate(keys):
        features, parents, strengths = expected[key]
        wanted = torch.stack(features).amax(0) if features else torch.zeros(5)
        assert torch.equal(new.features[i], wanted)
        assert int(new.parents[i]) in parents
        assert float(new.strength[i]) == pytest.approx(max(strengths))
        assert float(new.cells[i]) == ROOT / 2 ** key[0]
    assert not new.further["extra_levels"].any()


def test_no_anchor_grows_without_eligible_offsets():
    rng = np.random.default_rng(0)
    asked = replace(request(rng), eligible=torch.zeros(12, 3, dtype=torch.bool))
    assert len(grown(parameters(rng), asked, THRESHOLDS, NEAR_CAMERA)) == 0


def test_candidates_that_too_few_cameras_see_do_not_grow():
    rng = np.random.default_rng(1)
    tensors, asked = parameters(rng, 40, share=0.5), request(rng, 40)
    # L* of level 1 is reached within 4 * 2^-0.5 = 2.83, that of level 2 within 1.41.
    cameras = torch.tensor([[0.0, 0, 0], [0.0, 0, -90], [0.0, 0, 90]], dtype=torch.float64)
    levels = grown(tensors, asked, THRESHOLDS, cameras).further["levels"]
    assert len(levels) > 0 and not levels.any()
    close = torch.zeros(3, 3, dtype=torch.float64)
    assert grown(tensors, asked, THRESHOLDS, close).further["levels"].any()


def test_an_offset_far_outside_the_scene_does_not_grow():
    tensors = parameters(np.random.default_rng(2), 2)
    tensors["offsets"][0] = 1e38
    tensors["scales"][1] = 200.0
    asked = GrowthRequest(torch.full((2, 3), 1.0), torch.ones(2, 3, dtype=torch.bool))
    assert len(grown(tensors, asked, THRESHOLDS, NEAR_CAMERA)) == 0


def test_an_extra_level_requires_a_mean_gradient_above_a_quarter_of_the_level_threshold():
    rng = np.random.default_rng(3)
    tensors, asked = parameters(rng, 50), request(rng, 50)
    asked.eligible[:5] = False
    gradient = asked.gradient * 0.25
    quarter = Thresholds(0.25 * 2e-4, 2**0.2)
    farther = seen_from_farther(tensors, GrowthRequest(gradient, asked.eligible), quarter)
    for p, level in enumerate(tensors["levels"].tolist()):
        seen = [float(g) for g, e in zip(gradient[p], asked.eligible[p], strict=True) if e]
        wanted = bool(seen) and sum(seen) / len(seen) >= 0.25 * 2e-4 * 2 ** (0.2 * level)
        assert bool(farther[p]) == wanted
    assert 0 < int(farther.sum()) < 45


SCHEDULE = OctreeControl().window(Schedule.for_run(40_000))


def context(tensors, backbone, *, step=2000, room=1000, gradient=1e-4):
    """A step in which one view decoded all anchors and drew all Gaussians."""
    view = sample_scene().train_views[0]
    anchors, slots = tensors["offsets"].shape[:2]
    place = torch.arange(anchors * slots)
    count = len(place)
    drawn = Gaussians(
        torch.zeros(count, 3),
        torch.zeros(count, 4),
        torch.ones(count, 3),
        torch.full((count,), 0.5),
        origin=place // slots,
        slot=place % slots,
        decoded=torch.ones(anchors, dtype=torch.bool),
    )
    moved = torch.zeros(count, 2)
    moved[:, 0] = gradient / (view.camera.width / 2)
    screen = Screen(torch.ones(count, dtype=torch.int32), mean_gradient=moved)
    return DensifyContext(
        step=step,
        schedule=SCHEDULE,
        scene=sample_scene(),
        states={},
        rng=np.random.default_rng(0),
        parameters=tensors,
        backbone=backbone,
        rasterizer=None,
        views=(view_record(view, drawn, screen),),
        means_lr=0.0,
        room=room,
    )


def fresh(seed=0):
    """A trained-looking octree of the sample scene."""
    backbone = Octree(offsets=3, feature=4, visible_threshold=0.0)
    rng = np.random.default_rng(seed)
    tensors = backbone.create(sample_scene(), rng)
    for name in ("offsets", "features"):
        values = rng.normal(0, 1, tensors[name].shape)
        tensors[name] = torch.from_numpy(values).float().requires_grad_()
    return backbone, tensors


def test_edits_keep_every_anchor_on_a_separate_lattice_site():
    backbone, tensors = fresh()
    control, state = OctreeControl(success_threshold=0), PluginState()
    rng = np.random.default_rng(1)
    for step in range(2000, 2500, 100):
        before = primitives_of(backbone.blocks(), tensors)
        gradient = torch.from_numpy(rng.uniform(0, 4e-4, before * 3)).float()
        ctx = context(tensors, backbone, step=step, gradient=gradient)
        # Some anchors are transparent and will be pruned.
        drawn = ctx.views[0].gaussians
        faint = torch.where(drawn.origin % 7 == 0, 1e-4, 0.5)
        record = replace(ctx.views[0], gaussians=replace(drawn, opacities=faint))
        edit, state = control.densify(replace(ctx, views=(record,)), state)
        assert isinstance(edit, Edit) and edit.counts["grown"] > 0 and edit.counts["pruned"] > 0
        kept = edit.source[~edit.fresh]
        old = tensors
        tensors = apply_to_parameters(edit, backbone.blocks(), tensors)
        state = state.gathered(*gather_indices(edit, before, torch.device("cpu")))
        for name in ("anchors", "levels"):
            assert torch.equal(tensors[name][: len(kept)], old[name][kept])
        assert not tensors["extra_levels"][len(kept) :].any()
        assert not tensors["offsets"][len(kept) :].any()
        check_sites(tensors)
    assert (tensors["extra_levels"] > 0).any()
    assert tensors["levels"].dtype == torch.int64


def check_sites(tensors):
    places = Lattice.of(tensors["lattice"]).coordinates(tensors["anchors"], tensors["levels"])
    assert float((places - places.round()).abs().max()) < 1e-3
    rows = torch.cat([tensors["levels"][:, None], places.round().long()], 1).tolist()
    assert len({tuple(row) for row in rows}) == len(rows)
    assert int(tensors["levels"].max()) < int(tensors["lattice"][5])


def test_the_strongest_candidates_grow_first_near_the_limit():
    backbone, tensors = fresh()
    control = OctreeControl(success_threshold=0, extra_level=0.0)
    gradient = torch.linspace(1e-4, 9e-4, tensors["offsets"].shape[0] * 3)
    everything, _ = control.densify(context(tensors, backbone, gradient=gradient), PluginState())
    edit, _ = control.densify(context(tensors, backbone, gradient=gradient, room=4), PluginState())
    assert edit.counts["grown"] == 4
    assert edit.counts["held_back"] == everything.counts["grown"] - 4 > 0
    none, _ = control.densify(context(tensors, backbone, gradient=gradient, room=0), PluginState())
    assert none.source is None and none.counts["held_back"] == everything.counts["grown"]


def test_new_anchors_start_with_the_size_of_their_cells():
    backbone, tensors = fresh()
    edit, _ = OctreeControl(success_threshold=0).densify(
        context(tensors, backbone, gradient=9e-4), PluginState()
    )
    after = apply_to_parameters(edit, backbone.blocks(), tensors)
    new = edit.fresh.nonzero().squeeze(1)
    cells = float(tensors["lattice"][3]) * 0.5 ** after["levels"][new].double()
    assert torch.allclose(after["scales"][new], cells.log().float()[:, None].expand(-1, 6))


@pytest.mark.parametrize(("total", "mode"), [(40_000, "scaled"), (30_000, "absolute")])
def test_schedule_times_are_as_published_at_the_published_length_or_on_request(total, mode):
    schedule = OctreeControl().window(Schedule.for_run(total, mode))
    assert schedule.lr_until == 40_000
    edits = [step for step in range(1, 40_001) if schedule.densifies(step)]
    assert edits == list(range(1600, 25_000, 100))
    assert not any(schedule.resets(step) for step in range(1, 40_001))


@pytest.mark.parametrize("total", [300, 2000, 10_000, 400_000])
def test_schedule_times_scale_with_the_run(total):
    schedule = OctreeControl().window(Schedule.for_run(total))
    edits = [step for step in range(1, total + 1) if schedule.densifies(step)]
    assert edits[0] > total * 1500 / 40_000 - 1 and edits[-1] < total * 25_000 / 40_000
    assert edits[1:] == [] or edits[1] - edits[0] == max(50, math.floor(total / 400))


def test_statistics_end_with_growth():
    backbone, tensors = fresh()
    edit, state = OctreeControl().densify(context(tensors, backbone, step=25_000), PluginState())
    assert edit.is_empty and not state.per_primitive
