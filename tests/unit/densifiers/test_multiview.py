"""Multi-view density control: rules by hand, planted errors, whole runs."""

import gc
from dataclasses import replace
from itertools import permutations
from math import ceil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.brute_force import trace
from support.multiview import TRAIN, VIEWS, Shown, context, parameters_of, recorded

from crossgrad_backbones.mip import MipSplatting
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    PluginState,
    apply_to_moment,
    apply_to_parameters,
)
from crossgrad_core.contract.schedule import Counting, Phase, Schedule, ViewsPerStepSpec
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import HEIGHT, WIDTH, sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.densifiers.clone_split import Plan
from crossgrad_plugins.densifiers.error_pixel_counts import ERROR, MARKED, VISITS
from crossgrad_plugins.densifiers.multiview import MultiViewDensityControl, some_of
from crossgrad_plugins.rasterizers.numba_kernels.arrays import TileLists

# --- candidates of a pruning


def test_candidates_are_sampled_by_weight_without_replacement():
    """Compare the order of three candidates with the product of their remaining shares."""
    score = torch.tensor([0.0, 0.9, 0.5, 0.5])
    weight = 1 / (1 - score[:3].double().numpy())
    candidates = torch.tensor([True, True, True, False])
    draws = 4_000
    found = {}
    rng = np.random.default_rng(0)
    for _ in range(draws):
        drawn = some_of(candidates, score, 0.5, rng)  # Two of three.
        assert not drawn[3]
        pair = tuple(drawn.nonzero().squeeze(1).tolist())
        found[pair] = found.get(pair, 0) + 1
    expected = dict.fromkeys([(0, 1), (0, 2), (1, 2)], 0.0)
    for first, second in permutations(range(3), 2):
        share = weight[first] / weight.sum()
        share *= weight[second] / (weight.sum() - weight[first])
        expected[tuple(sorted((first, second)))] += share
    for pair, share in expected.items():
        assert abs(found[pair] / draws - share) < 4 * np.sqrt(share * (1 - share) / draws)


@given(number=st.integers(0, 30), share=st.floats(0.01, 1.0), seed=st.integers(0, 99))
def test_the_share_of_sampled_candidates_is_rounded_up(number, share, seed):
    rng = np.random.default_rng(seed)
    candidates = torch.zeros(40, dtype=torch.bool)
    candidates[rng.permutation(40)[:number]] = True
    score = torch.from_numpy(rng.random(40)).float()
    drawn = some_of(candidates, score, share, rng)
    assert int(drawn.sum()) == ceil(share * number)
    assert not (drawn & ~candidates).any()


def test_the_candidate_with_the_largest_error_is_always_sampled():
    score = torch.tensor([0.99, 1.0, 0.5, 0.0])
    for seed in range(50):
        drawn = some_of(torch.ones(4, dtype=torch.bool), score, 0.25, np.random.default_rng(seed))
        assert drawn.tolist() == [False, True, False, False]


# --- the edit


def planted(marked, gradient, absolute, *, drawn=(10,), error=None):
    """A state with sums of one regime."""
    column = torch.tensor(marked, dtype=torch.float32)[:, None]
    ones = torch.ones(len(marked))
    return PluginState(
        {"drawn": list(drawn)},
        per_primitive={
            "gradient": torch.tensor(gradient),
            "absolute": torch.tensor(absolute),
            "renders": ones,
            MARKED: column,
            ERROR: column if error is None else torch.tensor(error)[:, None],
            VISITS: ones[:, None],
        },
    )


class Planted(MultiViewDensityControl):
    """Takes the statistics as they are in the state."""

    def observed(self, context, state):
        return state


def few(scales, opacities):
    n = len(scales)
    return {
        "means": torch.arange(3.0 * n).reshape(n, 3).requires_grad_(),
        "scales": torch.tensor(scales).log()[:, None].repeat(1, 3).requires_grad_(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1).requires_grad_(),
        "opacities": torch.logit(torch.tensor(opacities)).requires_grad_(),
        "f_dc": torch.zeros(n, 1, 3).requires_grad_(),
        "f_rest": torch.zeros(n, 15, 3).requires_grad_(),
    }


FLOATS = st.sampled_from([0.0, 1e-4, 1.9e-4, 2e-4, 1e-3, 1.2e-3, 5e-3])


@given(data=st.data(), rows=st.integers(1, 8))
@settings(max_examples=60, deadline=None)
def test_growth_agrees_with_the_published_rule(data, rows):
    lists = lambda values: data.draw(st.lists(values, min_size=rows, max_size=rows))  # noqa: E731
    scales = lists(st.sampled_from([1e-4, 9.9e-4, 1.1e-3, 0.05]))
    marked, g, ga = lists(st.integers(40, 80)), lists(FLOATS), lists(FLOATS)
    params = few(scales, [0.5] * rows)
    edit, _ = Planted().densify(context(params=params), planted(marked, g, ga))
    expected = set()
    for i in range(rows):
        important = marked[i] // 10 > 5
        small = scales[i] <= 0.001
        threshold = 2e-4 if small else 1.2e-3
        # As float32 has them.
        if important and np.float32(g[i] if small else ga[i]) >= np.float32(threshold):
            expected.add(i)
    grown = {
        i for i in range(rows) if edit.source is not None and edit.source.tolist().count(i) > 1
    }
    assert grown == expected


def test_the_largest_error_per_visit_grows_first_near_the_limit():
    state = planted([90, 80, 99, 100], [1.0] * 4, [1.0] * 4, error=[5.0, 9.0, 7.0, 1.0])
    params = few([1e-4] * 4, [0.5] * 4)
    edit, _ = Planted().densify(replace(context(params=params), room=2), state)
    assert edit.source.tolist() == [0, 1, 2, 3, 1, 2]
    assert edit.counts["held_back"] == 2


def test_half_of_the_pruning_candidates_are_removed_and_remaining_opacities_are_capped():
    params = few([1e-4] * 7, [0.001, 0.002, 0.003, 0.004, 0.9, 0.79, 0.81])
    state = planted([0] * 7, [0.0] * 7, [0.0] * 7, error=[0.0, 1.0, 0.9999, 0.0, 0.0, 0.0, 0.0])
    edit, _ = Planted().densify(context(params=params), state)
    assert edit.source.tolist() == [0, 3, 4, 5, 6]  # The two with a large share in the error go.
    assert edit.counts["pruned"] == 2 and edit.counts["capped"] == 2
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    opacities = torch.sigmoid(new["opacities"].detach())
    assert opacities.tolist() == pytest.approx([0.001, 0.004, 0.8, 0.79, 0.8], rel=1e-4)
    moments = apply_to_moment(edit, "opacities", torch.ones(7))
    assert moments.tolist() == [1, 1, 0, 1, 0]  # What is not capped keeps its moments.


def test_the_opacity_cap_applies_after_the_filter_of_the_backbone():
    backbone = MipSplatting()
    params = parameters_of(backbone)
    with torch.no_grad():
        params["opacities"][:] = 4.0
    state = planted([0] * 40, [0.0] * 40, [0.0] * 40)
    edit, _ = Planted().densify(context(backbone=backbone, params=params), state)
    new = backbone.prepare(
        apply_to_parameters(edit, backbone.blocks(), params),
        sample_scene(),
        Phase(600, True, Schedule.for_run(30_000)),
    )
    phase = Phase(600, True, Schedule.for_run(30_000))
    drawn = backbone.decode(new, TRAIN[0].camera, phase).opacities
    assert float(drawn.detach().max()) <= 0.8 + 1e-5


def test_multiview_without_a_cap_and_with_full_pruning_prunes_like_adc():
    params = few([1e-4] * 4, [0.001, 0.002, 0.9, 0.5])
    state = planted([0] * 4, [0.0] * 4, [0.0] * 4)
    edit, _ = Planted(cap_opacity=1, prune_share=1).densify(context(params=params), state)
    assert edit.source.tolist() == [2, 3] and not edit.values


def test_opacities_are_reset_as_published_and_a_reset_overrides_the_cap():
    params = few([1e-4] * 4, [0.5, 0.6, 0.9, 0.95])
    state = planted([0] * 4, [0.0] * 4, [0.0] * 4)
    edit, _ = Planted().densify(context(params=params, step=3000), state)
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    assert torch.sigmoid(new["opacities"]).max().item() == pytest.approx(0.01)
    assert "capped" not in edit.counts


@pytest.mark.parametrize(("total", "every"), [(30_000, 500), (12_000, 200), (3_000, 100)])
def test_the_interval_between_edits_is_as_published(total, every):
    schedule = Schedule.for_run(total)
    window = MultiViewDensityControl().window(schedule)
    assert (window.densify_from, window.densify_every) == (500, every)
    assert window.densify_until == total // 2
    larger = MultiViewDensityControl(interval=1 / 300).window(Schedule.for_run(30_000))
    assert larger.densify_every == 100


@pytest.mark.parametrize("total", [98, 240, 700])
def test_short_runs_edit_only_if_min_refinements_requests_edits(total):
    counting = Counting("views", ViewsPerStepSpec((1,)), 12, min_refinements=6)
    window = MultiViewDensityControl().window(Schedule.for_run(total, counting=counting))
    assert window.edits() >= 6
    without = replace(counting, min_refinements=0)
    assert MultiViewDensityControl().window(Schedule.for_run(total, counting=without)).edits() == 0


# --- late prunings


def late(step, state, schedule=None, **options):
    ctx = context(step=step, rasterizer="numba")
    ctx = ctx if schedule is None else replace(ctx, schedule=schedule)
    return MultiViewDensityControl(**options).densify(ctx, state)


def test_late_prunings_happen_once_at_their_shares_of_the_run():
    state, times = EMPTY_STATE, []
    for step in (15_000, 17_999, 18_000, 18_001, 20_999, 21_000, 24_000, 26_999, 27_000, 30_000):
        edit, state = late(step, state)
        if edit.source is not None:
            times.append(step)
    assert times == [18_000, 21_000, 24_000, 27_000]
    assert state.values == {"late": 4}


def test_late_prunings_remove_faint_gaussians_and_gaussians_with_the_largest_error():
    ctx = context(step=18_000, rasterizer="numba")
    edit, _ = MultiViewDensityControl(views=VIEWS).densify(ctx, EMPTY_STATE)
    seen = MultiViewDensityControl(views=VIEWS)
    score = seen.importance_of(seen.rendered(ctx)).pruning_score
    opacities = torch.sigmoid(ctx.parameters["opacities"].detach())
    expected = ((opacities >= 0.1) & (score <= 0.9)).nonzero().squeeze(1)
    assert edit.source.tolist() == expected.tolist()
    assert 0 < edit.counts["pruned"] == 40 - len(expected)
    assert float(score[opacities >= 0.1].max()) > 0.9


def test_late_prunings_can_be_disabled_and_never_run_without_density_control():
    assert late(18_000, EMPTY_STATE, late_prunings=())[0].is_empty
    short = Schedule.for_run(600)
    assert not short.grows
    assert late(590, EMPTY_STATE, short)[0].is_empty


def test_a_run_that_becomes_shorter_prunes_once_for_all_missed_prunings():
    longer = Schedule.for_run(30_000)
    _, state = late(17_000, EMPTY_STATE, longer)
    shorter = replace(longer, length=20_000, total=20_000)
    edit, state = late(17_001, state, shorter)
    assert edit.source is not None and state.values == {"late": 3}
    edit, state = late(17_002, state, replace(longer, length=90_000))
    assert edit.is_empty and state.values == {"late": 3}


def test_unused_options_are_named():
    idle = lambda **options: set(MultiViewDensityControl(**options).unused_options(None))  # noqa: E731
    assert idle() == {"share"}
    assert idle(count="running") == set()
    assert idle(count="running", late_prunings=()) == {"views", "late_opacity", "late_score"}


# --- planted errors


def with_photos(params, backbone, wrong):
    """The scene whose photos are the renders themselves, but for the pixels of `wrong`."""
    scene = sample_scene()
    ctx = context(backbone=backbone, params=params, rasterizer="numba")
    views = list(scene.views)
    for place, index in enumerate(scene.train):
        with torch.no_grad():
            image = ctx.render(place).image
        photo = (image.clamp(0, 1) * 255).round().to(torch.uint8)
        off = wrong(views[index])
        photo[off] = 255 - photo[off]
        views[index] = replace(views[index], photo=Shown(photo))
    return replace(scene, views=tuple(views))


def grown_by(method, ctx, state):
    """What grows where every gradient is large."""
    ones = {name: torch.ones(40) for name in ("gradient", "absolute", "renders")}
    state = PluginState(state.values, per_primitive={**ones, **state.per_primitive})
    edit, _ = method.densify(ctx, state)
    source = [] if edit.source is None else edit.source.tolist()
    return {i for i in range(40) if source.count(i) > 1}


def counted(method, ctx):
    """The counts of all training views, by either way."""
    if method.count == "render":
        return method.rendered(ctx)
    records = tuple(recorded(ctx, index) for index in range(VIEWS))
    return method.counted(replace(ctx, views=records), PluginState())


@pytest.mark.parametrize("count", ["render", "running"])
def test_exactly_the_gaussians_with_wrong_pixels_grow(count):
    """The photos are wrong where one Gaussian is blended. Only Gaussians in these pixels grow."""
    backbone = Vanilla()
    params = backbone.create(sample_scene(), np.random.default_rng(0))
    with torch.no_grad():
        params["means"] *= 3.0
        params["scales"] -= 4.0
        params["opacities"][:] = 2.0
    phase = Phase(600, True, Schedule.for_run(30_000))
    blended = {
        view.name: trace(backbone.decode(params, view.camera, phase), view.camera).blended
        for view in sample_scene().views
    }
    chosen = 7

    def wrong(view):
        off = blended[view.name][chosen].copy()
        off[0, 0] = True  # In a view without errors the roundings would be the largest ones.
        return torch.from_numpy(off)

    scene = with_photos(params, backbone, wrong)
    ctx = context(params=params, scene=scene, rasterizer="numba")
    method = Planted(count=count, share=1.0, views=VIEWS, importance=0)
    grown = grown_by(method, ctx, counted(method, ctx))
    meets = {
        i for i in range(40) if any((blended[v.name][i] & wrong(v).numpy()).any() for v in TRAIN)
    }
    assert chosen in grown and grown <= meets
    assert len(meets) < 30


@pytest.mark.parametrize("count", ["render", "running"])
def test_errors_of_one_regime_are_not_averaged_with_other_regimes(count):
    """Near photos are wrong, and far photos are wrong in one pixel.

    A mean over all photos would be too small.
    """
    params = parameters_of(backbone := Vanilla())

    def wrong(view):
        off = torch.full((HEIGHT, WIDTH), view.regime == "near")
        off[0, 0] = True
        return off

    scene = with_photos(params, backbone, wrong)
    ctx = context(params=params, scene=scene, rasterizer="numba")
    marked = {}
    for regimes in (False, True):
        method = Planted(count=count, share=1.0, views=VIEWS, regimes=regimes)
        marked[regimes] = method.importance_of(counted(method, ctx)).marked
    mean, far, near = marked[False][:, 0], *marked[True].unbind(1)
    assert float(far.max()) <= 1.0 < float(mean.max()) < float(near.max())
    between = float(((mean + near) / 2).max())
    grown = {}
    for regimes in (False, True):
        method = Planted(count=count, share=1.0, views=VIEWS, regimes=regimes, importance=between)
        grown[regimes] = grown_by(method, ctx, counted(method, ctx))
    assert not grown[False] and grown[True]


# --- runs


def run_of(views=1, backbone="vanilla", rasterizer="numba", steps=9, **options):
    config = RunConfig(
        steps=60, schedule_unit="steps", densify_from=1, densify_until=30, densify_every=3,
        sampler=ComponentChoice(name="random"), views_per_step=views,
        backbone=ComponentChoice(name=backbone), rasterizer=ComponentChoice(name=rasterizer),
        densifier=ComponentChoice(name="multiview", **options), exposure={"name": "gain"},
    )  # fmt: skip
    state = first_state(setup := assemble(config, sample_scene(), "none"))
    return setup, state, [timed_step(setup, state) for _ in range(steps)]


EAGER = {"importance": 0, "grad_threshold": 1e-9, "abs_threshold": 1e-9}


#: Every two of a K, a way to count and a backbone meet.
RUNS = [
    (1 + (place + turn) % 3, ("render", "running")[(place + turn // 2) % 2], backbone)
    for place, backbone in enumerate(["vanilla", "mip", "pixel", "analytic", "distance"])
    for turn in range(3)
]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("views", "count", "backbone"), RUNS)
def test_runs_grow_for_any_k_and_every_gaussian_backbone(views, count, backbone):
    _, state, records = run_of(views, backbone, count=count, regimes=views > 1, **EAGER)
    edits = [r.counts.get("cloned", 0) + r.counts.get("split", 0) > 0 for r in records]
    assert edits == [step % 3 == 0 for step in range(1, 10)]
    assert all(tensor.isfinite().all() for tensor in state.parameters.values())


def test_extra_renders_are_counted_and_the_running_variant_needs_none():
    for count, more in (("render", 10 * 3), ("running", 0)):
        _, state, _ = run_of(count=count, views=1, **EAGER)
        assert state.counters.views == 9 + min(more, VIEWS * 3)


def test_no_per_view_data_is_kept_after_its_step():
    """The pixel count keeps tile lists of a view in memory, at most for one step."""
    setup, state, _ = run_of(2, count="running", share=1.0, steps=4, **EAGER)
    gc.collect()
    before = sum(type(each) is TileLists for each in gc.get_objects())
    for _ in range(6):
        timed_step(setup, state)
    gc.collect()
    after = sum(type(each) is TileLists for each in gc.get_objects())
    assert after <= before
    held = state.states["densifier"].per_primitive
    primitives = state.primitives(setup)
    assert sum(tensor.nbytes for tensor in held.values()) <= 6 * 4 * primitives


def test_a_rasterizer_without_pixel_counts_is_refused():
    selection = assemble(
        RunConfig(steps=10, densifier=ComponentChoice(name="multiview")), sample_scene(), "none"
    ).selection
    from crossgrad_core.contract.objections import objections_to

    class Plain(type(selection.rasterizer)):
        provides = frozenset({"abs_gradient"})

    reasons = objections_to(replace(selection, rasterizer=Plain()))
    assert any("needs the screen statistics count" in reason for reason in reasons)


def test_children_take_their_scores_from_their_parent():
    """Pruning also uses the scores of children. A child has the error share of its parent."""
    plan = Plan(torch.tensor([0, 1, 1]), torch.tensor([False, True, True]), torch.zeros(3).bool())
    params = few([1e-4, 1e-4], [0.5, 0.001])
    state = planted([0, 0], [0.0, 0.0], [0.0, 0.0], error=[0.0, 1.0])
    gone = Planted(prune_share=1.0).pruned(context(params=params), state, plan, {})
    assert gone.tolist() == [False, True, True]
