"""Counts of erroneous pixels per primitive: by brute force, and what they say of primitives."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.brute_force import trace
from support.multiview import TRAIN, VIEWS, Shown, context, recorded

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.gaussians import Screen
from crossgrad_core.contract.schedule import Phase
from crossgrad_core.testing.fixtures import HEIGHT, WIDTH, sample_scene
from crossgrad_plugins.densifiers.error_pixel_counts import (
    ERROR,
    MARKED,
    VISITS,
    MultiViewScore,
    drawn_views,
    erroneous,
)
from crossgrad_plugins.densifiers.multiview import MultiViewDensityControl


class Bright(Vanilla):
    """Vanilla with every other primitive drawn by two Gaussians."""

    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        number = len(gaussians)
        origin = torch.cat([torch.arange(number), torch.arange(0, number, 2)])
        return replace(gaussians.mapped(lambda tensor: tensor[origin]), origin=origin)


# --- the erroneous pixels of a view


def brute_erroneous(image, photo, mask, threshold):
    error = np.abs(image.astype(float) - photo.astype(float) / 255).mean(-1)
    kept = error if mask is None else error[mask]
    if kept.size == 0 or kept.max() == kept.min():
        return np.zeros(error.shape, bool), np.full(error.shape, np.inf)
    share = (error - kept.min()) / (kept.max() - kept.min())
    return (share > threshold) & (True if mask is None else mask), np.abs(share - threshold)


@given(
    seed=st.integers(0, 2**16),
    size=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    threshold=st.sampled_from([0.0, 0.1, 0.5, 0.99]),
    scale=st.sampled_from([1e-6, 0.3, 1.0, 1e4]),
    masked=st.sampled_from([None, 0.0, 0.3, 1.0]),
)
def test_erroneous_pixels_are_relative_to_the_view(seed, size, threshold, scale, masked):
    rng = np.random.default_rng(seed)
    photo = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    image = (photo / 255 + scale * rng.normal(size=(*size, 3))).astype(np.float32)
    mask = None if masked is None else rng.random(size) < masked
    view = SimpleNamespace(
        image=torch.from_numpy(image),
        photo=torch.from_numpy(photo),
        mask=None if mask is None else torch.from_numpy(mask),
    )
    expected, gap = brute_erroneous(image, photo, mask, threshold)
    found = erroneous(view, threshold).numpy()
    # Where the error is all but the threshold, rounding of float32 decides.
    sure = gap > 1e-5 + 2e-6 / scale
    assert np.array_equal(found[sure], expected[sure])


def test_masked_pixels_are_never_marked():
    image = torch.full((4, 5, 3), torch.nan)
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[1, 1:4] = True
    image[1, 1:4] = torch.tensor([0.0, 0.5, 1.0])[:, None]
    view = SimpleNamespace(image=image, photo=torch.zeros(4, 5, 3, dtype=torch.uint8), mask=mask)
    assert erroneous(view, 0.1).nonzero().tolist() == [[1, 2], [1, 3]]
    assert not erroneous(replace_mask(view, torch.zeros_like(mask)), 0.1).any()


def replace_mask(view, mask):
    return SimpleNamespace(image=view.image, photo=view.photo, mask=mask)


def test_no_pixel_is_marked_if_all_errors_are_equal():
    image = torch.full((3, 3, 3), 0.25)
    view = SimpleNamespace(image=image, photo=torch.zeros(3, 3, 3, dtype=torch.uint8), mask=None)
    assert not erroneous(view, 0.0).any()


# --- which views are rendered


@pytest.mark.parametrize("number", [1, 2, 5, 10, 100])
def test_views_are_sampled_evenly_from_all_groups(number):
    columns = [0] * 7 + [1] * 2 + [2] * 30
    seen = set()
    for seed in range(200):
        drawn = drawn_views(columns, number, np.random.default_rng(seed))
        assert len(set(drawn)) == len(drawn)
        found = np.bincount([columns[view] for view in drawn], minlength=3)
        wanted = [max(1, number // 3 + (group < number % 3)) for group in range(3)]
        assert found.tolist() == [min(w, m) for w, m in zip(wanted, (7, 2, 30), strict=True)]
        seen.update(drawn)
    assert number > 2 or seen == set(range(39))


# --- counts


def brute_counts(ctx, index, threshold=0.1, mask=None):
    """[P] erroneous pixels that a primitive is blended in, and how many of them are in doubt."""
    view = ctx.scene.train_views[index]
    phase = Phase(ctx.step, training=True, schedule=ctx.schedule)
    gaussians = ctx.backbone.decode(ctx.parameters, view.camera, phase)
    drawn = trace(gaussians, view.camera)
    marked, gap = brute_erroneous(drawn.image, view.photo.image().numpy(), mask, threshold)
    doubtful = (gap < 1e-4) | (drawn.pixel_gaps < 2e-4)
    owners = range(len(gaussians)) if gaussians.origin is None else gaussians.origin.tolist()
    counts, shown = np.zeros(40), np.zeros(40)
    for i, owner in enumerate(owners):
        counts[owner] += (drawn.blended[i] & marked & ~doubtful).sum()
        shown[owner] += drawn.touched[i]
    return counts, shown > 0, int(doubtful.sum())


@pytest.mark.sampled(3)
@pytest.mark.parametrize("rasterizer", ["torch", "numba"])
@pytest.mark.parametrize("backbone", [Vanilla(), Bright()], ids=["one", "two per primitive"])
@pytest.mark.parametrize("masked", [False, True])
def test_error_counts_agree_with_brute_force(rasterizer, backbone, masked):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[2:14, 3:20] = True
    scene = sample_scene()
    if masked:
        views = (replace(v, photo=Shown(v.photo.image(), mask)) for v in scene.views)
        scene = replace(scene, views=tuple(views))
    ctx = context(backbone=backbone, rasterizer=rasterizer, scene=scene)
    method = MultiViewDensityControl(views=VIEWS)
    state = method.rendered(ctx)
    assert state.values == {"drawn": [VIEWS]}
    found = [brute_counts(ctx, i, mask=mask.numpy() if masked else None) for i in range(VIEWS)]
    expected = np.sum([counts for counts, _, _ in found], axis=0)
    doubts = sum(doubt for _, _, doubt in found)
    assert doubts < 12 and (expected > 0).sum() > 20
    doubts *= 2 if isinstance(backbone, Bright) else 1  # Both may be blended in such a pixel.
    assert np.abs(state.per_primitive[MARKED][:, 0].numpy() - expected).max() <= doubts
    shown = np.sum([shown for _, shown, _ in found], axis=0)
    assert np.array_equal(state.per_primitive[VISITS][:, 0].numpy(), shown)
    losses = [recorded(ctx, i).loss for i in range(VIEWS)]
    error = np.sum([c * loss for (c, _, _), loss in zip(found, losses, strict=True)], axis=0)
    assert state.per_primitive[ERROR][:, 0].numpy() == pytest.approx(error, abs=doubts, rel=1e-5)


@pytest.mark.parametrize("regimes", [False, True])
def test_the_running_count_covers_exactly_the_rendered_views(regimes):
    ctx = context(step=601)
    method = MultiViewDensityControl(count="running", share=1.0, regimes=regimes)
    state = PluginState()
    for indices in ((0, 5), (3,), (7, 8, 1)):
        records = tuple(recorded(ctx, index) for index in indices)
        state = method.counted(replace(ctx, views=records), state)
    found = {index: recorded(ctx, index) for index in (0, 5, 3, 7, 8, 1)}
    names = ["far", "near"] if regimes else [""]
    expected = np.zeros((40, len(names), 3))
    for index, record in found.items():
        counts = record.screen.count(erroneous(record, 0.1)).double().numpy()
        column = names.index(TRAIN[index].regime) if regimes else 0
        shown = record.screen.radii.numpy() > 0
        expected[:, column] += np.stack([counts, counts * record.loss, shown], axis=-1)
    for place, name in enumerate((MARKED, ERROR, VISITS)):
        assert state.per_primitive[name].numpy() == pytest.approx(expected[..., place], rel=1e-6)
    seen = method.importance_of(state)
    visits = np.maximum(expected[..., 2], 1)
    assert seen.marked.numpy() == pytest.approx(expected[..., 0] / visits, rel=1e-6)
    assert seen.error.numpy() == pytest.approx(expected[..., 1] / visits, rel=1e-6)
    assert seen.rank.numpy() == pytest.approx(expected[..., 1] / visits**0.75, rel=1e-6)


def test_counting_uses_a_share_of_the_steps_and_always_the_step_of_the_edit():
    ctx = context(step=601, rng=np.random.default_rng(0))
    record = recorded(ctx, 0)
    method = MultiViewDensityControl(count="running", share=0.25)
    state = PluginState()
    for _ in range(400):
        state = method.counted(replace(ctx, views=(record,)), state)
    visits = float(state.per_primitive[VISITS].max())
    assert 60 < visits < 140
    at_edit = replace(ctx, step=600, views=(record,))
    assert float(method.counted(at_edit, state).per_primitive[VISITS].max()) == visits + 1


def test_marked_pixels_count_in_full_photo_pixels_at_any_render_scale():
    """If a quarter of the pixels is rendered, each pixel counts four times."""
    ctx = context(rasterizer="numba")
    record = recorded(ctx, 4, 0.5)
    assert record.image.shape[:2] == (HEIGHT // 2, WIDTH // 2)
    method = MultiViewDensityControl(count="running", share=1.0)
    state = method.counted(replace(ctx, views=(record,)), PluginState())
    counts = record.screen.count(erroneous(record, 0.1))
    assert counts.sum() > 0
    assert torch.equal(state.per_primitive[MARKED][:, 0], 4.0 * counts)


def test_extra_renders_have_the_scale_and_background_of_the_step():
    ctx = context(rasterizer="numba")
    asked = []

    def render(index, scale, outputs, background):
        asked.append((scale, background))
        return ctx.render(index, scale, outputs, background)

    views = (replace(recorded(ctx, 4, 0.5), background=torch.full((3,), 0.7)),)
    MultiViewDensityControl(views=3).rendered(replace(ctx, render=render, views=views))
    assert [scale for scale, _ in asked] == [0.5] * 3
    assert all(float(background.mean()) == pytest.approx(0.7) for _, background in asked)


# --- what they say


counts = st.integers(0, 40)


@given(data=st.data(), rows=st.integers(1, 6), regimes=st.integers(1, 3))
@settings(max_examples=60)
def test_the_multiview_score_agrees_with_its_formulas(data, rows, regimes):
    shape = (rows, regimes)

    def draw(values):
        size = rows * regimes
        found = data.draw(st.lists(values, min_size=size, max_size=size))
        return np.array(found).reshape(shape)

    marked, visits = draw(counts).astype(float), draw(st.integers(0, 9)).astype(float)
    error = marked * draw(st.floats(0.01, 1.0))
    views = st.lists(st.integers(1, 10), min_size=regimes, max_size=regimes)
    drawn = data.draw(st.one_of(st.none(), views))
    tensors = {name: torch.from_numpy(value) for name, value in
               ((MARKED, marked), (ERROR, error), (VISITS, visits))}  # fmt: skip
    values = {} if drawn is None else {"drawn": drawn}
    seen = MultiViewDensityControl().importance_of(PluginState(values, per_primitive=tensors))
    per = np.maximum(visits if drawn is None else np.array(drawn)[None], 1)
    assert np.array_equal(seen.above(5.0).numpy(), np.floor(marked / per) > 5)
    total = (error / per).sum(1)
    span = total.max() - total.min()
    expected = (total - total.min()) / span if span > 0 else np.zeros(rows)
    assert seen.pruning_score.numpy() == pytest.approx(expected)


def brute_places(rank, grows):
    """The best place of each row among those that grow, by counting those before it."""
    best = []
    for i in range(len(rank)):
        places = [
            sum(
                grows[j, r] and (rank[j, r] > rank[i, r] or (rank[j, r] == rank[i, r] and j < i))
                for j in range(len(rank))
            )
            for r in range(rank.shape[1])
            if grows[i, r]
        ]
        best.append(min(places, default=np.inf))
    return -np.array(best, dtype=float)


@given(seed=st.integers(0, 2**16), rows=st.integers(0, 12), regimes=st.integers(1, 3))
def test_regimes_alternate_in_the_growth_order(seed, rows, regimes):
    rng = np.random.default_rng(seed)
    rank = rng.integers(0, 5, (rows, regimes)).astype(np.float32)
    grows = rng.random((rows, regimes)) < 0.6
    tensor = torch.from_numpy(rank)
    found = MultiViewScore(tensor, tensor, tensor).strength(torch.from_numpy(grows))
    assert found.tolist() == brute_places(rank, grows).tolist()


def test_rasterizer_output_without_a_pixel_count_is_reported_as_a_fault_of_the_rasterizer():
    ctx = context()
    record = replace(recorded(ctx, 0), screen=Screen(torch.ones(40, dtype=torch.int32)))
    method = MultiViewDensityControl(count="running", share=1.0)
    with pytest.raises(RuntimeError, match="returned no pixel counts"):
        method.counted(replace(ctx, views=(record,)), PluginState())
