"""Growing and pruning of anchors against a slow computation with dictionaries."""

from dataclasses import replace
from math import exp, log

import numpy as np
import pytest
import torch

from crossgrad_backbones.anchors.growth.control import AnchorControl
from crossgrad_backbones.anchors.voxels import (
    FARTHEST,
    cells_of,
    free_cells,
    in_reach,
    numbered,
)
from crossgrad_backbones.scaffold import Scaffold
from crossgrad_core.contract.blocks import (
    NO_EDIT,
    PluginState,
    apply_to_moment,
    apply_to_parameters,
)
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.testing.support.renders import view_record

SCHEDULE = AnchorControl().window(Schedule.for_run(30_000))
CAMERA = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, torch.eye(4, dtype=torch.float64))
SLOTS, FEATURE, VOXEL = 3, 4, 0.01
BACKBONE = Scaffold(offsets=SLOTS, feature=FEATURE, voxel_size=VOXEL)
EDIT = 1600


def model(anchors=30, seed=0):
    """Anchors on voxels of a small box, offsets of up to some coarse cells."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-6, 7, (anchors, 3)), axis=0)
    count = len(cells)
    values = {
        "anchors": cells * VOXEL,
        "offsets": rng.normal(0.0, 8.0, (count, SLOTS, 3)),
        "features": rng.normal(size=(count, FEATURE)),
        "scales": np.log(VOXEL) + rng.normal(0.0, 0.3, (count, 6)),
    }
    parameters = {name: torch.from_numpy(value).float() for name, value in values.items()}
    parameters["voxel_size"] = torch.tensor(VOXEL, dtype=torch.float64)
    return parameters


def context(parameters, views=(), *, step=EDIT, room=10_000, rng=0, schedule=SCHEDULE):
    return DensifyContext(
        step=step,
        schedule=schedule,
        scene=None,
        states={},
        rng=np.random.default_rng(rng),
        parameters=parameters,
        backbone=BACKBONE,
        rasterizer=None,
        views=tuple(views),
        means_lr=0.0,
        room=room,
    )


def record(anchors, decoded, origin, slot, drawn):
    opacities, radii, gradients = drawn
    number = len(origin)
    gaussians = Gaussians(
        torch.zeros(number, 3),
        torch.zeros(number, 4),
        torch.ones(number, 3),
        torch.tensor(opacities),
        colors=torch.zeros(number, 3),
        origin=torch.tensor(origin, dtype=torch.int64),
        slot=torch.tensor(slot, dtype=torch.int64),
        decoded=torch.tensor([row in decoded for row in range(anchors)], dtype=torch.bool),
    )
    radii = torch.tensor(radii, dtype=torch.int32)
    screen = Screen(radii, mean_gradient=torch.tensor(gradients).float().reshape(number, 2))
    view = View("a.jpg", CAMERA, None, "near", np.zeros(0, np.int64))
    return view_record(view, gaussians, screen)


def drawn_records(anchors, views, seed=0):
    """Random views: some anchors are decoded, some of their slots drawn, some of these unseen."""
    rng = np.random.default_rng(seed)
    records = []
    for _ in range(views):
        decoded = set(np.flatnonzero(rng.random(anchors) < 0.8).tolist())
        pairs = [(a, j) for a in sorted(decoded) for j in range(SLOTS) if rng.random() < 0.7]
        number = len(pairs)
        records.append(
            record(
                anchors,
                decoded,
                [a for a, _ in pairs],
                [j for _, j in pairs],
                (
                    rng.uniform(0.01, 1.0, number).tolist(),
                    rng.integers(0, 3, number).tolist(),
                    rng.normal(0.0, 1e-5, (number, 2)).tolist(),
                ),
            )
        )
    return records


def tallied(records):
    """Dictionaries of the sums of section 2.5."""
    opacity, views, gradient, renders = {}, {}, {}, {}
    for each in records:
        for row in each.gaussians.decoded.nonzero().squeeze(1).tolist():
            views[row] = views.get(row, 0) + 1
        for i, (row, slot) in enumerate(
            zip(each.gaussians.origin.tolist(), each.gaussians.slot.tolist(), strict=True)
        ):
            opacity[row] = opacity.get(row, 0.0) + float(each.gaussians.opacities[i])
            if each.screen.radii[i] > 0:
                x, y = each.screen.mean_gradient[i].tolist()
                norm = np.hypot(x * CAMERA.width / 2, y * CAMERA.height / 2)
                gradient[row, slot] = gradient.get((row, slot), 0.0) + norm
                renders[row, slot] = renders.get((row, slot), 0) + 1
    return opacity, views, gradient, renders


def table(sums, shape):
    full = np.zeros(shape)
    for key, value in sums.items():
        full[key] = value
    return full


def test_anchor_statistics_are_sums_over_the_views():
    parameters = model()
    count = len(parameters["anchors"])
    records = drawn_records(count, 7)
    state = PluginState()
    for step, pair in enumerate((records[:2], records[2:4], records[4:7])):
        edit, state = AnchorControl().densify(context(parameters, pair, step=801 + step), state)
        assert edit == NO_EDIT
    opacity, views, gradient, renders = tallied(records)
    found = state.per_primitive
    np.testing.assert_allclose(found["opacity"], table(opacity, count), rtol=1e-5)
    np.testing.assert_array_equal(found["views"], table(views, count))
    np.testing.assert_allclose(found["gradient"], table(gradient, (count, SLOTS)), rtol=1e-5)
    np.testing.assert_array_equal(found["renders"], table(renders, (count, SLOTS)))


@pytest.mark.parametrize(("step", "gathers"), [(500, False), (501, True), (14_999, True)])
def test_anchor_statistics_start_after_a_sixtieth_of_the_run(step, gathers):
    parameters = model()
    records = drawn_records(len(parameters["anchors"]), 1)
    _, state = AnchorControl().densify(context(parameters, records, step=step), PluginState())
    assert bool(state.per_primitive) == gathers


def test_statistics_are_discarded_after_the_last_edit():
    parameters = model()
    records = drawn_records(len(parameters["anchors"]), 1)
    edit, state = AnchorControl().densify(context(parameters, records, step=15_000), PluginState())
    assert edit == NO_EDIT and not state.per_primitive


def test_the_densification_window_of_anchors_is_as_published_and_has_no_resets():
    assert (SCHEDULE.densify_from, SCHEDULE.densify_until) == (1500, 15_000)
    assert SCHEDULE.reset_every is None
    assert not SCHEDULE.densifies(1500) and SCHEDULE.densifies(1600)


@pytest.mark.parametrize(
    ("total", "mode", "every"),
    [(300, "scaled", 50), (2000, "scaled", 50), (60_000, "scaled", 200), (2000, "absolute", 100)],
)
def test_short_runs_edit_twice_as_often_as_published(total, mode, every):
    assert AnchorControl().window(Schedule.for_run(total, mode)).densify_every == every


def state_of(parameters, seed=0, most=90):
    """Statistics in which about half of the offsets and anchors can be judged."""
    rng = np.random.default_rng(seed)
    count = len(parameters["anchors"])
    renders = rng.integers(0, most, (count, SLOTS)).astype(np.float32)
    means = 10 ** rng.uniform(-4.5, -2.5, (count, SLOTS))
    views = rng.integers(0, 170, count).astype(np.float32)
    per_view = 10 ** rng.uniform(-4, -1, count)
    sums = {
        "opacity": views * per_view,
        "views": views,
        "gradient": renders * means,
        "renders": renders,
    }
    return PluginState(per_primitive={n: torch.from_numpy(v).float() for n, v in sums.items()})


def cell(position, size):
    return tuple(round(float(x) / size) for x in position)


def slow_growth(parameters, state, rng):
    """{level: {cell: (largest features, largest gradient)}} by the rules of section 2.6."""
    x, o, f, s = (
        parameters[n].double().numpy() for n in ("anchors", "offsets", "features", "scales")
    )
    gradient, renders = (state.per_primitive[n].double().numpy() for n in ("gradient", "renders"))
    present = [tuple(position) for position in x]
    added = {}
    for level in range(3):
        if level > 0 and not any(added.values()):
            break
        size = VOXEL * (16 // 4**level)
        candidates = [
            (a, j)
            for a in range(len(x))
            for j in range(SLOTS)
            if renders[a, j] > 40 and gradient[a, j] / renders[a, j] >= 2e-4 * 2**level
        ]
        draws = rng.random(len(candidates))
        taken = {cell(position, size) for position in present}
        new = {}
        for (a, j), draw in zip(candidates, draws, strict=True):
            wanted = cell(x[a] + o[a, j] * np.exp(s[a, :3]), size)
            if draw >= 1 - 0.5 ** (level + 1) or wanted in taken:
                continue
            features, strength = new.get(wanted, (np.full(FEATURE, -np.inf), 0.0))
            mine = gradient[a, j] / renders[a, j]
            new[wanted] = (np.maximum(features, f[a]), max(strength, mine))
        added[level] = new
        present += [tuple(c * size for c in wanted) for wanted in new]
    return added


@pytest.mark.parametrize("seed", range(4))
def test_growth_agrees_with_the_published_rules(seed):
    parameters = model(seed=seed)
    state = state_of(parameters, seed)
    edit, _ = AnchorControl(prune_opacity=0.0).densify(context(parameters, rng=seed), state)
    wanted = slow_growth(parameters, state, np.random.default_rng(seed))
    assert sum(map(len, wanted.values())) > 10
    if seed == 0:
        assert all(len(new) > 0 for new in wanted.values())
    count = len(parameters["anchors"])
    assert edit.source[:count].tolist() == list(range(count))
    assert edit.fresh.tolist() == [False] * count + [True] * (len(edit.fresh) - count)
    new = apply_to_parameters(edit, BACKBONE.blocks(), parameters)
    found = {level: {} for level in wanted}
    for row in range(count, len(edit.fresh)):
        scales = new["scales"][row].double()
        assert torch.equal(scales, scales[:1].expand(6))
        size = exp(float(scales[0]))
        level = round(log(16 * VOXEL / size, 4))
        position = new["anchors"][row].double().numpy()
        place = cell(position, size)
        np.testing.assert_allclose(position, np.array(place) * size, atol=1e-6)
        assert place not in found[level]
        found[level][place] = new["features"][row].numpy()
        assert not new["offsets"][row].any()
    for level, cells in wanted.items():
        assert found[level].keys() == cells.keys()
        for place, (features, _) in cells.items():
            np.testing.assert_allclose(found[level][place], features, rtol=1e-6)


def test_a_level_of_anchors_grows_only_after_a_coarser_level_has_grown():
    parameters = model()
    state = state_of(parameters)
    # All stay in the one cell of 16 voxels that is taken, but not in their own voxels.
    parameters["offsets"].clamp_(-0.7, 0.7)
    edit, _ = AnchorControl(prune_opacity=0.0).densify(context(parameters), state)
    assert edit.source is None
    fine, _ = AnchorControl(prune_opacity=0.0, coarsest=1, levels=1).densify(
        context(parameters), state
    )
    assert fine.counts["grown"] > 0


@pytest.mark.parametrize("room", [0, 1, 7])
def test_the_largest_gradients_grow_first_near_the_limit(room):
    parameters = model()
    state = state_of(parameters)
    whole = slow_growth(parameters, state, np.random.default_rng(0))
    strengths = sorted((s for new in whole.values() for _, s in new.values()), reverse=True)
    edit, _ = AnchorControl(prune_opacity=0.0).densify(context(parameters, room=room), state)
    assert edit.counts["held_back"] == len(strengths) - room
    if room == 0:
        assert edit.source is None
        return
    count = len(parameters["anchors"])
    new = apply_to_parameters(edit, BACKBONE.blocks(), parameters)
    places = {
        (level, place): s for level, cells in whole.items() for place, (_, s) in cells.items()
    }
    found = []
    for row in range(count, len(edit.fresh)):
        size = exp(float(new["scales"][row, 0].double()))
        level = round(log(16 * VOXEL / size, 4))
        found.append(places[level, cell(new["anchors"][row].double(), size)])
    assert sorted(found, reverse=True) == pytest.approx(strengths[:room])


def test_transparent_anchors_are_pruned_after_enough_views():
    parameters = model()
    count = len(parameters["anchors"])
    state = state_of(parameters)
    edit, new_state = AnchorControl(grad_threshold=1e9).densify(context(parameters), state)
    views, opacity = (state.per_primitive[n].tolist() for n in ("views", "opacity"))
    gone = [a for a in range(count) if views[a] > 80 and opacity[a] < 0.005 * views[a]]
    assert 3 < len(gone) < count - 3
    assert edit.source.tolist() == [a for a in range(count) if a not in gone]
    assert dict(edit.counts) == {"grown": 0, "pruned": len(gone)}
    assert len(new_state.per_primitive["views"]) == count


@pytest.mark.parametrize("share", [0.5, 1.5])
def test_statistics_from_a_share_of_the_views_give_the_same_growth_and_pruning(share):
    parameters = model()
    whole = state_of(parameters)
    part = PluginState(per_primitive={n: share * sums for n, sums in whole.per_primitive.items()})
    expected, kept = AnchorControl().densify(context(parameters), whole)
    found, left = AnchorControl().densify(replace(context(parameters), share=share), part)
    assert dict(found.counts) == dict(expected.counts) and min(expected.counts.values()) > 0
    assert torch.equal(found.source, expected.source)
    # As many views as all of them would be are judged too early, or too late.
    other, _ = AnchorControl().densify(context(parameters), part)
    assert dict(other.counts) != dict(expected.counts)
    for name, sums in kept.per_primitive.items():
        assert torch.equal(left.per_primitive[name], share * sums)


def test_an_anchor_that_never_contributes_is_removed():
    parameters = model()
    count = len(parameters["anchors"])
    state = PluginState()
    view = record(count, {0, 1}, [1], [0], ([0.5], [1], [[0.0, 0.0]]))
    for step in range(1510, EDIT + 1):
        edit, state = AnchorControl().densify(context(parameters, [view], step=step), state)
    assert edit.source.tolist() == list(range(1, count))


@pytest.mark.parametrize(("total", "renders", "views"), [(30_000, 40, 80), (6000, 20, 40)])
def test_statistics_of_judged_offsets_restart_and_other_statistics_continue(total, renders, views):
    parameters = model()
    state = state_of(parameters)
    schedule = AnchorControl().window(Schedule.for_run(total))
    edit, after = AnchorControl(grad_threshold=1e9, prune_opacity=0.0).densify(
        context(parameters, schedule=schedule), state
    )
    before = {name: each.numpy() for name, each in state.per_primitive.items()}
    for name, counter, least in (
        ("gradient", "renders", renders),
        ("renders", "renders", renders),
        ("opacity", "views", views),
        ("views", "views", views),
    ):
        wanted = np.where(before[counter] > least, 0.0, before[name])
        np.testing.assert_array_equal(after.per_primitive[name], wanted)
        assert 0 < np.count_nonzero(wanted) < np.count_nonzero(before[name])
    assert edit.source is None


def test_rows_of_statistics_moments_and_parameters_are_edited_alike():
    parameters = model()
    count = len(parameters["anchors"])
    state = state_of(parameters)
    edit, after = AnchorControl().densify(context(parameters), state)
    grown, pruned = edit.counts["grown"], edit.counts["pruned"]
    assert grown > 0 and pruned > 0
    gathered = after.gathered(edit.source, edit.fresh).per_primitive
    new = apply_to_parameters(edit, BACKBONE.blocks(), parameters)
    rows = count - pruned + grown
    for name in ("anchors", "offsets", "features", "scales"):
        assert len(new[name]) == rows
        moment = apply_to_moment(edit, name, torch.ones_like(parameters[name]))
        assert len(moment) == rows
        assert not moment[count - pruned :].any()
        assert moment[: count - pruned].all()
    for tensor in gathered.values():
        assert len(tensor) == rows
        assert not tensor[count - pruned :].any()


def test_sizes_are_capped_at_an_edit_and_keep_their_moments():
    parameters = model()
    parameters["scales"][:, 5] = 0.2
    parameters["scales"][:, 1] = 0.3
    state = state_of(parameters)
    edit, _ = AnchorControl(grad_threshold=1e9, prune_opacity=0.0).densify(
        context(parameters), state
    )
    new = apply_to_parameters(edit, BACKBONE.blocks(), parameters)["scales"]
    assert torch.equal(new[:, :5], parameters["scales"][:, :5])
    assert torch.equal(new[:, 5], torch.full_like(new[:, 5], 0.05))
    moments = torch.ones_like(new)
    assert torch.equal(apply_to_moment(edit, "scales", moments), moments)


def test_an_empty_model_is_not_an_error():
    parameters = {n: t[:0] if t.dim() else t for n, t in model().items()}
    edit, state = AnchorControl().densify(
        context(parameters, [record(0, set(), [], [], ([], [], []))]), PluginState()
    )
    assert edit.source is None
    assert all(len(tensor) == 0 for tensor in state.per_primitive.values())


def test_two_cells_have_the_same_number_exactly_if_they_are_equal():
    rng = np.random.default_rng(0)
    cells = rng.integers(-3, 4, (500, 3)) * np.array([1, 2**30, -(2**35)])
    found = numbered(torch.from_numpy(cells)).tolist()
    names = {}
    for row, number in zip(map(tuple, cells.tolist()), found, strict=True):
        assert names.setdefault(row, number) == number
    assert len(set(names.values())) == len(names)
    assert sorted(set(found)) == list(range(len(names)))


def test_free_cells_are_the_unoccupied_cells_without_duplicates():
    wanted = torch.tensor([[1, 0, 0], [0, 0, 0], [1, 0, 0], [2, 5, 5], [0, 1, 0]])
    taken = torch.tensor([[0, 0, 0], [2, 5, 5], [9, 9, 9]])
    first, place = free_cells(wanted, taken)
    assert sorted(wanted[first].tolist()) == [[0, 1, 0], [1, 0, 0]]
    assert place[1] == place[3] == -1
    for row in (0, 2, 4):
        assert wanted[first[place[row]]].tolist() == wanted[row].tolist()


def test_positions_outside_the_integer_range_of_cells_are_marked():
    positions = torch.tensor([[0.0, 0.0, 0.0], [1e30, 0.0, 0.0], [float("nan"), 0.0, 0.0]])
    cells = cells_of(positions, 0.5)
    assert in_reach(cells).tolist() == [True, False, False]
    assert int(cells.abs().max()) == FARTHEST


def test_offsets_outside_the_range_of_cells_do_not_grow():
    parameters = model()
    parameters["offsets"][:] = 1e30
    edit, _ = AnchorControl(prune_opacity=0.0).densify(context(parameters), state_of(parameters))
    assert edit.source is None


def test_gaussians_without_slots_are_reported_as_an_error_of_the_backbone():
    parameters = model()
    (view,) = drawn_records(len(parameters["anchors"]), 1)
    view = replace(view, gaussians=replace(view.gaussians, slot=None))
    with pytest.raises(RuntimeError, match="offset"):
        AnchorControl().densify(context(parameters, [view], step=900), PluginState())
