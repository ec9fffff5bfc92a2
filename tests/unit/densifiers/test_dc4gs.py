"""DC4GS against its rules, pixel by pixel and child by child."""

from dataclasses import replace
from math import exp, hypot, log

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import NO_EDIT, PluginState, apply_to_parameters
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.errors import IncompatibleSelectionError
from crossgrad_core.run import assemble as assembling
from crossgrad_core.run import select as selecting
from crossgrad_core.testing.fixtures import sample_scene, step_fields
from crossgrad_core.testing.support.renders import view_record
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.densifiers.dc4gs import DirectionalConsistency, split_positions

CAMERA = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, torch.eye(4, dtype=torch.float64))
HALF = (100.0, 50.0)
EDGES = (-2, -1, 0, 1, 2)


def pixels_of(number, seed=0, size=1e-5):
    """For each of `number` Gaussians a list of (place, gradient x, gradient y) per pixel."""
    rng = np.random.default_rng(seed)
    lists = []
    for i in range(number):
        count = rng.integers(0, 12) if i % 5 else 0
        pull = rng.normal(size=2) * (i % 3)
        rows = np.concatenate([rng.normal(0, 2, (count, 1)), rng.normal(pull, 1, (count, 2))], 1)
        lists.append(rows * [1.0, size, size])
    return lists


def binned(lists):
    """What a rasterizer gives for these pixels: [N, 6, 5]."""
    result = np.zeros((len(lists), 6, 5))
    for i, rows in enumerate(lists):
        for place, gx, gy in rows:
            ndc = np.array([gx * HALF[0], gy * HALF[1]])
            number = sum(place >= edge for edge in EDGES)
            result[i, number] += [*(ndc / hypot(*ndc)), abs(gx), abs(gy), 1]
    return torch.from_numpy(result).float()


def score_of(rows):
    """(1 - R) ga of some pixels; R = 1 where there are none."""
    if not len(rows):
        return 0.0
    ndc = np.array(rows)[:, 1:] * HALF
    mean = (ndc / np.linalg.norm(ndc, axis=1, keepdims=True)).mean(axis=0)
    return (1 - hypot(*mean)) * hypot(*np.abs(ndc).sum(axis=0))


def record(lists, radii=None, origin=None):
    number = len(lists)
    shown = [len(rows) > 0 for rows in lists] if radii is None else radii
    signed = np.array([rows[:, 1:].sum(axis=0) if len(rows) else (0.0, 0.0) for rows in lists])
    screen = Screen(
        radii=torch.tensor([4 * int(each) for each in shown], dtype=torch.int32),
        mean_gradient=torch.from_numpy(signed).float().view(number, 2),
        directions=binned(lists),
    )
    zeros = torch.zeros(number, 3)
    gaussians = Gaussians(zeros, torch.zeros(number, 4), zeros, torch.ones(number), origin=origin)
    view = View("a.jpg", CAMERA, None, "near", np.zeros(0, np.int64))
    return view_record(view, gaussians, screen)


def parameters(number, largest=0.05, opacity=0.5, seed=0):
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.001, 0.01, (number, 3))
    scales[np.arange(number), rng.integers(0, 3, number)] = largest
    tensors = {
        "means": rng.normal(size=(number, 3)),
        "scales": np.log(scales),
        "quats": rng.normal(size=(number, 4)),
        "opacities": np.full(number, log(opacity / (1 - opacity))),
        "f_dc": rng.normal(size=(number, 1, 3)),
        "f_rest": rng.normal(size=(number, 15, 3)),
    }
    return {name: torch.from_numpy(t).float().requires_grad_() for name, t in tensors.items()}


def context(views, params, *, step=600, room=10**6):
    return DensifyContext(
        **step_fields(step), parameters=params, backbone=Vanilla(), rasterizer=None,
        views=tuple(views), means_lr=1e-4, room=room,
    )  # fmt: skip


def observed(views, number):
    params = parameters(number)
    _, state = DirectionalConsistency().densify(context(views, params, step=1), PluginState())
    return {name: tensor.double().numpy() for name, tensor in state.per_primitive.items()}


def test_dc4gs_statistics_are_means_over_the_pixels():
    views = [pixels_of(40, seed) for seed in (1, 2, 3)]
    totals = observed([record(lists) for lists in views], 40)
    for i in range(40):
        lists = [view[i] for view in views if len(view[i])]
        assert totals["renders"][i] == len(lists)
        whole = sum(score_of(rows) for rows in lists)
        assert totals["inconsistency"][i] == pytest.approx(whole, rel=1e-4, abs=1e-9)
        for plane, edge in enumerate(EDGES):
            sides = [
                (score_of(rows[rows[:, 0] < edge]) + score_of(rows[rows[:, 0] >= edge])) / 2
                for rows in lists
            ]
            assert totals["planes"][i, plane] == pytest.approx(sum(sides), rel=1e-4, abs=1e-9)


def test_opposite_pixel_gradients_are_inconsistent_and_equal_ones_are_not():
    same = np.array([[0.5, 1e-5, 0.0], [-0.5, 3e-5, 0.0]])
    opposite = np.array([[0.5, 1e-5, 0.0], [-0.5, -3e-5, 0.0]])
    nothing = np.zeros((0, 3))
    totals = observed([record([same, opposite, nothing], radii=[1, 1, 1])], 3)
    assert totals["inconsistency"].tolist() == pytest.approx([0.0, 4e-3, 0.0], abs=1e-9)
    # The middle plane parts the opposite ones: both sides are consistent.
    assert totals["planes"][1].tolist() == pytest.approx([2e-3, 2e-3, 0.0, 2e-3, 2e-3], abs=1e-9)
    assert totals["renders"].tolist() == [1, 1, 1]


def test_statistics_of_decoded_gaussians_are_added_to_their_primitives():
    lists = pixels_of(8, 4)
    origin = torch.tensor([3, 1, 1, 0, 3, 2, 0, 1])
    split = observed([record(lists, origin=origin)], 4)
    apart = observed([record(lists)], 8)
    for name, totals in split.items():
        for primitive in range(4):
            expected = apart[name][(origin == primitive).numpy()].sum(axis=0)
            assert totals[primitive] == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_split_position_is_the_minimum_of_the_fitted_polynomial(seed):
    rng = np.random.default_rng(seed)
    scores = np.abs(rng.normal(size=(50, 5))) * 10 ** rng.uniform(-6, 2, (50, 1))
    nodes = np.arange(1, 6) / 6
    places = np.concatenate([np.linspace(1 / 12, 11 / 12, 1000), nodes])
    found = split_positions(torch.from_numpy(scores)).numpy()
    for each, position in zip(scores, found, strict=True):
        fit = np.polyfit(nodes, each, 4)
        least = np.polyval(fit, places).min()
        assert 1 / 12 <= position <= 11 / 12
        assert np.polyval(fit, position) == pytest.approx(least, abs=1e-8 * np.abs(each).max())


def test_split_positions_of_known_polynomials_are_correct():
    nodes = torch.arange(1, 6, dtype=torch.float64) / 6
    minimum = torch.tensor([0.2, 0.5, 0.61, 0.9], dtype=torch.float64)[:, None]
    scores = (nodes - minimum) ** 2 + 0.3 * (nodes - minimum) ** 4
    assert split_positions(scores).tolist() == pytest.approx(minimum[:, 0].tolist(), abs=5e-4)
    for value in (0.0, 1.0, 0.1, 1e-38, 1e30):
        assert split_positions(torch.full((1, 5), value)).item() == 0.5
    # The same whichever end is called left.
    flipped = split_positions(scores.flip(1))
    assert flipped.tolist() == pytest.approx((1 - minimum[:, 0]).tolist(), abs=5e-4)
    assert split_positions(torch.zeros(0, 5)).shape == (0,)


def parting(places, size=1e-4):
    """Two crowds of pixels that pull apart, either side of a place."""
    offsets = np.linspace(-2.9, 2.9, 30)
    return np.array([[t, size if t < places else -size, 1e-9] for t in offsets])


def test_children_are_placed_on_both_sides_of_the_splitting_plane():
    params = parameters(3, opacity=0.7)
    view = record([parting(-1.0), parting(0.0), parting(1.0)])
    edit, state = DirectionalConsistency().densify(context([view], params), PluginState())
    assert dict(edit.counts) == {"cloned": 0, "split": 3, "pruned": 0}
    assert edit.source.tolist() == [0, 1, 2, 0, 1, 2] and edit.fresh.all()
    assert all(tensor.eq(0).all() for tensor in state.per_primitive.values())
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    old = {name: tensor.detach().double().numpy() for name, tensor in params.items()}
    fresh = {name: tensor.detach().double().numpy() for name, tensor in new.items()}
    for i, expected in enumerate((1 / 3, 1 / 2, 2 / 3)):
        k = int(old["scales"][i].argmax())
        sigma, w = exp(old["scales"][i, k]), old["quats"][i]
        axis = Rotation.from_quat([*w[1:], w[0]]).as_matrix()[:, k]
        share = exp(fresh["scales"][i, k] - old["scales"][i, k])
        assert share == pytest.approx(expected, abs=0.05)
        for child, part, middle in ((i, share, -3 * (1 - share)), (i + 3, 1 - share, 3 * share)):
            shift = fresh["means"][child] - old["means"][i]
            assert shift == pytest.approx(middle * sigma * axis, abs=1e-5)
            assert exp(fresh["scales"][child, k]) == pytest.approx(part * sigma, rel=1e-4)
            others = [j for j in range(3) if j != k]
            assert fresh["scales"][child, others].tolist() == old["scales"][i, others].tolist()
            opacity = 1 / (1 + exp(-fresh["opacities"][child]))
            assert opacity == pytest.approx(0.7 * part, rel=1e-4)
            for name in ("quats", "f_dc", "f_rest"):
                assert np.array_equal(fresh[name][child], old[name][i])


def test_small_gaussians_are_cloned_by_mean_gradient_and_large_ones_split_by_directions():
    # Gradient 1e-4 px^-1 in x is 1e-2 in NDC.
    pulled = np.array([[0.1, 1e-4, 0.0], [0.2, 1e-4, 0.0]])
    view = record([pulled, parting(0.0), pulled, parting(0.0)])
    params = parameters(4)
    with torch.no_grad():
        params["scales"][:2] = log(0.005)
    edit, _ = DirectionalConsistency().densify(context([view], params), PluginState())
    assert edit.source.tolist() == [0, 1, 2, 0, 3, 3]
    assert edit.counts["cloned"] == 1 and edit.counts["split"] == 1


def test_the_mean_statistic_over_views_is_compared_with_the_split_threshold():
    # (1 - 0) ga = 2e-5 * 100 * 30 in the first view, nothing in the second.
    views = [record([parting(0.0, 2e-5)]), record([parting(9.0, 2e-5)])]
    for threshold, grows in ((0.029, True), (0.031, False)):
        densifier = DirectionalConsistency(split_threshold=threshold)
        edit, _ = densifier.densify(context(views, parameters(1)), PluginState())
        assert (edit.counts.get("split", 0) == 1) is grows


@pytest.mark.parametrize("logit", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("log_scale", [-80.0, 0.0, 20.0])
def test_extreme_parents_have_finite_children(logit, log_scale):
    params = parameters(2)
    with torch.no_grad():
        params["opacities"][:] = logit
        params["scales"][:, 0] = log_scale
        params["quats"][0] = 0.0
    densifier = DirectionalConsistency(prune_opacity=0.0, split_scale=1e-40)
    view = record([parting(0.0), parting(1.0)])
    edit, _ = densifier.densify(context([view], params), PluginState())
    assert all(rows.values.isfinite().all() for rows in edit.values.values())
    assert edit.source.shape[0] == 4


def test_the_largest_excess_over_the_threshold_grows_first_near_the_limit():
    view = record([parting(0.0, size) for size in (1e-4, 3e-4, 2e-4)])
    edit, _ = DirectionalConsistency().densify(
        context([view], parameters(3), room=1), PluginState()
    )
    assert edit.source.tolist() == [0, 2, 1, 1]
    assert edit.counts["held_back"] == 2


def test_no_statistics_are_collected_after_the_end():
    view = record([parting(0.0)])
    edit, state = DirectionalConsistency().densify(
        context([view], parameters(1), step=15_000), PluginState()
    )
    assert edit == NO_EDIT and not state.per_primitive


EARLY = {"schedule_unit": "steps", "densify_from": 1, "densify_until": 7, "densify_every": 2}


def setup_of(rasterizer, **options):
    config = RunConfig(
        steps=10,
        sampler=ComponentChoice(name="random"),
        views=2,
        densifier=ComponentChoice(name="dc4gs", **options),
        rasterizer=ComponentChoice(name=rasterizer),
        **EARLY,
    )
    return assembling.assemble(config, sample_scene(), "none")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rasterizer", ["numba", "torch"])
def test_a_run_splits_and_requests_directions_only_while_needed(rasterizer):
    options = {"split_scale": 1e-3, "split_threshold": 1e-6, "grad_threshold": 1e-6}
    setup = setup_of(rasterizer, **options)
    asked = []

    class Watched(type(setup.rasterizer)):
        def render(self, gaussians, camera, background, outputs=frozenset()):
            asked.append("directions" in outputs)
            return super().render(gaussians, camera, background, outputs)

    setup = replace(setup, selection=replace(setup.selection, rasterizer=Watched()))
    state = first_state(setup)
    records = [timed_step(setup, state) for _ in range(8)]
    assert [record.counts.get("split", 0) > 0 for record in records] == [False, True] * 3 + [
        False,
        False,
    ]
    assert asked == [True] * 12 + [False] * 4
    assert all(tensor.isfinite().all() for tensor in state.parameters.values())


def test_a_rasterizer_without_directions_is_refused(monkeypatch):
    build = selecting.build

    def blind(slot, name, options):
        component = build(slot, name, options)
        if slot is not Rasterizer:
            return component
        kind = type(component)

        class Blind(kind):
            provides = kind.provides - {"directions"}

        return Blind()

    monkeypatch.setattr(selecting, "build", blind)
    with pytest.raises(IncompatibleSelectionError) as refused:
        setup_of("numba")
    assert "densifier dc4gs needs the screen statistics directions" in refused.value.found
