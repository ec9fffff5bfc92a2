"""Gradients of K views: Gramians, weighted sums, overlaps, and accumulation."""

import numba
import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import EMPTY_STATE, Block, LearningRate
from crossgrad_core.contract.contexts import AggregateContext
from crossgrad_core.contract.gramian_operator import aggregate_by_gramians
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.deferred import DeferredSums
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.sparse_rows import sparse_rows, values_of
from crossgrad_core.gradients.summed import SummedGradients
from crossgrad_core.registry.entries import build
from crossgrad_operators.projection import Symmetric
from crossgrad_operators.sum import Sum

RATE = LearningRate(1.0)
BLOCKS = (
    Block("means", ("means",), True, "geometry", RATE),
    Block("scales", ("scales",), True, "geometry", RATE),
    Block("opacities", ("opacities",), True, "appearance", RATE),
    Block("mlp", ("mlp.0", "mlp.1"), False, "neutral", RATE),
)
SHAPES = {"means": (50, 3), "scales": (50, 3), "opacities": (50, 1), "mlp.0": (7, 5), "mlp.1": (5,)}
GRANULARITIES = ("block", "kind", "global", "gaussian")
TENSORS = {
    "block": [["means"], ["scales"], ["opacities"], ["mlp.0", "mlp.1"]],
    "kind": [["means", "scales"], ["opacities"], ["mlp.0", "mlp.1"]],
    "global": [list(SHAPES)],
}


def make_views(count, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [
        {name: torch.randn(shape, generator=generator).to(dtype) for name, shape in SHAPES.items()}
        for _ in range(count)
    ]


def aggregate(operator, gradients, seed=0):
    views = gradients.views
    context = AggregateContext(
        step=1,
        schedule=None,
        scene=None,
        states={},
        rng=np.random.default_rng(seed),
        gradients=gradients,
        losses=np.ones(views),
        labels=None,
        distances=np.ones(views),
        reference_distance=1.0,
        blocks=BLOCKS,
    )
    return operator.aggregate(context, EMPTY_STATE)[0]


def naive_gramian(views, names):
    rows = [torch.cat([v[n].double().flatten() for n in names]) for v in views]
    return (torch.stack(rows) @ torch.stack(rows).T).numpy()


@pytest.mark.sampled(29)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 16])
@pytest.mark.parametrize("granularity", ["block", "kind", "global"])
def test_gramians_and_sums_agree_with_a_direct_computation(granularity, count, dtype):
    views = make_views(count, dtype)
    gradients = DenseGradients(views, BLOCKS)
    expected = np.stack([naive_gramian(views, names) for names in TENSORS[granularity]])
    np.testing.assert_allclose(gradients.gramians(granularity), expected, rtol=1e-12, atol=1e-11)
    weights = np.random.default_rng(1).standard_normal((len(expected), count))
    found = gradients.combine(weights, granularity)
    unit = torch.finfo(dtype).eps
    for row, names in zip(weights, TENSORS[granularity], strict=True):
        for name in names:
            exact = sum(w * v[name].double() for w, v in zip(row, views, strict=True))
            assert found[name].dtype == dtype
            assert float((found[name].double() - exact).abs().max()) <= 2 * unit * count


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_gramians_and_sums_per_primitive_agree_with_a_direct_computation(count, dtype):
    views = make_views(count, dtype)
    gradients = DenseGradients(views, BLOCKS)
    names, found = gradients.names("gaussian"), gradients.gramians("gaussian")
    assert names == ("means",) * 50 + ("scales",) * 50 + ("opacities",) * 50 + ("mlp",)
    rows = torch.stack([v["scales"].double() for v in views], dim=1)
    np.testing.assert_allclose(found[50:100], (rows @ rows.transpose(1, 2)).numpy(), atol=1e-13)
    np.testing.assert_allclose(found[-1], naive_gramian(views, ["mlp.0", "mlp.1"]), rtol=1e-13)
    weights = np.random.default_rng(1).standard_normal((151, count))
    combined = gradients.combine(weights, "gaussian")
    exact = (torch.from_numpy(weights[50:100, :, None]) * rows).sum(dim=1)
    assert float((combined["scales"].double() - exact).abs().max()) < 1e-5
    exact = sum(w * v["mlp.0"].double() for w, v in zip(weights[-1], views, strict=True))
    assert float((combined["mlp.0"].double() - exact).abs().max()) < 1e-5


def copied(view):
    return {name: None if g is None else g.clone() for name, g in view.items()}


def accumulation(views):
    gradients = SummedGradients.empty(BLOCKS, len(views))
    for view in views:
        gradients.add(copied(view))
    return gradients


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_accumulation_and_separate_gradients_give_the_same_bits(count, dtype):
    views = make_views(count, dtype)
    views[-1]["scales"] = None
    grown = dict.fromkeys(SHAPES)
    for view in views:
        for name, g in view.items():
            if g is not None:
                grown[name] = g.clone() if grown[name] is None else grown[name].add_(g)
    separate = aggregate(Sum(), DenseGradients(views, BLOCKS))
    together = aggregate(Sum(), accumulation(views))
    assert separate.counts == together.counts
    weights = np.ones((len(BLOCKS), count))
    weighted = DenseGradients(views, BLOCKS).combine(weights, "block")
    for name, expected in grown.items():
        for found in (separate.gradients, together.gradients, weighted):
            if expected is None:
                assert found[name] is None
            else:
                assert torch.equal(found[name], expected)


def test_a_non_finite_view_is_dropped_alike_by_accumulated_and_separate_gradients():
    views = make_views(3)
    views[1]["means"][4, 1] = float("nan")
    views[0]["mlp.1"][2] = float("inf")
    expected = {
        "means": views[0]["means"] + views[2]["means"],
        "mlp.0": views[1]["mlp.0"] + views[2]["mlp.0"],
        "mlp.1": views[1]["mlp.1"] + views[2]["mlp.1"],
    }
    separate = aggregate(Sum(), DenseGradients(views, BLOCKS))
    together = aggregate(Sum(), accumulation(views))
    for found in (separate, together):
        assert found.counts == {"zero": 0, "dropped": 2}
        for name, gradient in expected.items():
            assert torch.equal(found.gradients[name], gradient)


def test_blocks_without_a_finite_view_get_no_gradient():
    views = make_views(2)
    for view in views:
        view["means"][0, 0] = float("inf")
    joint = SummedGradients({n: views[0][n] + views[1][n] for n in SHAPES}, BLOCKS, 2)
    for gradients in (DenseGradients(views, BLOCKS), joint):
        found = aggregate(Sum(), gradients)
        assert found.gradients["means"] is None
        assert found.gradients["scales"] is not None
        assert found.counts["dropped"] == 1
    projected = aggregate(Symmetric(), DenseGradients(views, BLOCKS))
    assert projected.gradients["means"] is None
    assert projected.counts["dropped"] == 1


@pytest.mark.parametrize("granularity", GRANULARITIES)
def test_a_missing_gradient_counts_as_zero(granularity):
    views = make_views(2)
    zero = [views[0], {**views[1], "opacities": torch.zeros(50, 1)}]
    absent = [views[0], {n: g for n, g in views[1].items() if n != "opacities"}]
    operator = Symmetric(granularity=granularity)
    one = aggregate(operator, DenseGradients(zero, BLOCKS))
    other = aggregate(operator, DenseGradients(absent, BLOCKS))
    assert one.counts == other.counts
    for name in SHAPES:
        assert torch.equal(one.gradients[name], other.gradients[name])
    nowhere = [{**v, "opacities": None} for v in views]
    assert aggregate(operator, DenseGradients(nowhere, BLOCKS)).gradients["opacities"] is None


def test_events_of_an_aggregation_are_counted():
    """Use one block of each kind: conflicting, agreeing but disjoint, zero, and not finite."""
    one = {"means": torch.ones(50, 3), "scales": torch.zeros(50, 3), "opacities": torch.ones(50, 1)}
    two = {"means": -torch.ones(50, 3), "scales": torch.zeros(50, 3), "opacities": None}
    one["scales"][:25], two["scales"][25:] = 1.0, 1.0
    one |= {"mlp.0": torch.ones(7, 5), "mlp.1": torch.ones(5)}
    two |= {"mlp.0": torch.full((7, 5), float("nan")), "mlp.1": torch.ones(5)}
    found = aggregate(Symmetric(), DenseGradients([one, two], BLOCKS))
    assert found.counts == {"zero": 1, "disjoint": 1, "dropped": 1, "conflict": 1}
    assert torch.equal(found.gradients["scales"], one["scales"] + two["scales"])


def test_a_product_that_underflows_to_zero_does_not_count_as_disjoint():
    one = {"means": torch.ones(50, 3)}
    two = {"means": torch.ones(50, 3)}
    two["means"][:, 0], two["means"][:, 1] = -1.0, 0.0
    gradients = DenseGradients([one, two], BLOCKS)
    assert gradients.gramians("block")[0, 0, 1] == 0
    assert gradients.overlap("block")[0, 0, 1]
    assert not DenseGradients([one, {}], BLOCKS).overlap("block")[0, 0, 1]
    rows = gradients.overlap("gaussian")
    assert rows[:50, 0, 1].all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_overlap_is_computed_per_primitive(dtype):
    one, two = torch.zeros(50, 3, dtype=dtype), torch.zeros(50, 3, dtype=dtype)
    one[:, 0] = 1
    two[::2, 0], two[::2, 1], one[::2, 1] = 1, -1, 1
    two[1::2, 2] = 1
    gradients = DenseGradients([{"means": one}, {"means": two}], BLOCKS)
    assert not gradients.gramians("gaussian")[:50, 0, 1].any()
    assert gradients.overlap("gaussian")[:50, 0, 1].tolist() == [True, False] * 25


@pytest.mark.parametrize("views", [2, 5])
def test_numbers_of_threads_and_chunks_change_no_bit(views):
    generator = torch.Generator().manual_seed(0)
    big = [{"means": torch.randn(100_003, 3, generator=generator)} for _ in range(views)]
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            gradients = DenseGradients(big, BLOCKS[:1])
            weights = np.linspace(-1, 2, views)[None]
            rows = gradients.gramians("gaussian")
            combined = gradients.combine(weights, "block")["means"]
            results.append((gradients.gramians("block"), rows, combined))
    finally:
        numba.set_num_threads(before)
    for one, other in zip(*results, strict=True):
        assert np.array_equal(np.asarray(one), np.asarray(other))


def test_one_core_and_all_cores_give_the_same_bits():
    from crossgrad_core.gradients.numba_kernels import dense
    from crossgrad_core.numerics.jobs import parallel, serial

    rows = torch.randn(3, 50_001, generator=torch.Generator().manual_seed(0))
    addresses = np.array([[row.data_ptr() for row in rows]])
    sizes = np.array([50_001])
    table = dense.chunk_table(sizes)
    results = [torch.empty(50_001), torch.empty(50_001)]
    partials = [np.zeros((len(table), 3, 3)) for _ in results]
    weights = np.array([[1.5, -2.0, 0.25]])
    for run, out, partial in zip((serial, parallel), results, partials, strict=True):
        run(dense.gramians, addresses, sizes, table, partial)
        places = np.array([out.data_ptr()])
        run(dense.combine, addresses, weights, np.array([False]), 1.0, places, sizes, table)
    assert partials[0].any() and np.array_equal(*partials)
    assert torch.equal(*results)


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("views", [1, 2, 3, 5])
def test_an_overwriting_sum_gives_the_same_bits_and_works_only_once(granularity, views):
    operator = Symmetric(granularity=granularity)
    kept = make_views(views)
    expected = aggregate(operator, DenseGradients(kept, BLOCKS))
    gradients = DenseGradients(make_views(views), BLOCKS, overwrite=True)
    found = aggregate(operator, gradients)
    for name in SHAPES:
        assert torch.equal(found.gradients[name], expected.gradients[name])
    with pytest.raises(RuntimeError, match="overwritten"):
        gradients.total()
    for view, fresh in zip(kept, make_views(views), strict=True):
        assert all(torch.equal(view[name], fresh[name]) for name in SHAPES)


def test_gradients_may_have_any_memory_layout():
    views = make_views(2)
    turned = [{**v, "mlp.0": v["mlp.0"].T.contiguous().T, "means": v["means"]} for v in views]
    assert not turned[0]["mlp.0"].is_contiguous()
    one, other = (DenseGradients(v, BLOCKS).gramians("block") for v in (views, turned))
    np.testing.assert_array_equal(one, other)


def test_float64_gradients_outside_the_range_of_products_are_handled():
    views = [{"means": torch.full((50, 3), 1e200, dtype=torch.float64)} for _ in range(2)]
    views[1]["means"][:, 0] *= -4
    gradients = DenseGradients(views, BLOCKS[:1])
    gramian = gradients.gramians("block")[0]
    assert np.isfinite(gramian).all()
    cosine = gramian[0, 1] / np.sqrt(gramian[0, 0] * gramian[1, 1])
    assert cosine == pytest.approx(-2 / np.sqrt(3 * 18))
    found = aggregate(Symmetric(), gradients).gradients["means"]
    assert bool(torch.isfinite(found).all())
    assert gradients.present("block").all()


def test_aggregation_works_without_gaussians():
    views = [{"means": torch.zeros(0, 3)} for _ in range(2)]
    for granularity in GRANULARITIES:
        operator = Symmetric(granularity=granularity)
        found = aggregate(operator, DenseGradients(views, BLOCKS[:1]))
        assert found.gradients["means"].shape == (0, 3)


def test_elementwise_operators_receive_only_finite_views():
    views = make_views(2)
    views[0]["means"][0, 0] = float("nan")
    seen = {}

    def first(name, gradients):
        seen[name] = [g is not None for g in gradients]
        return next(g for g in gradients if g is not None)

    found = DenseGradients(views, BLOCKS).elementwise(first)
    assert seen["means"] == [False, True]
    assert seen["scales"] == [True, True]
    assert torch.equal(found["means"], views[1]["means"])


def test_accumulated_gradients_are_refused_by_operators_that_need_single_views():
    gradients = accumulation(make_views(2))
    assert gradients.views == 2
    with pytest.raises(TypeError, match="separate = True"):
        aggregate(Symmetric(), gradients)


def test_non_finite_weights_are_refused_and_the_operator_is_named():
    class Divides(Symmetric):
        def transform(self, gramians, context, state, rng):
            return np.full(gramians.shape, np.nan), state

    with pytest.raises(UserError, match="Divides"):
        aggregate(Divides(), DenseGradients(make_views(2), BLOCKS))


@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("name", ["symmetric", "cagrad", "gradvac", "confgate", "nash", "dispatch"])
def test_operators_accept_every_granularity(name, granularity):
    operator = build("operators", name, {"granularity": granularity})
    found = aggregate(operator, DenseGradients(make_views(2), BLOCKS))
    for gradient in found.gradients.values():
        assert bool(torch.isfinite(gradient).all())


@pytest.mark.sampled(17)
@pytest.mark.parametrize("absent", [0, 1, 2])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_the_mean_has_the_bits_of_the_sum_divided_by_the_number_of_views(count, dtype, absent):
    """The sum is divided once. Views without a gradient count in the divisor."""
    views = make_views(count, dtype)
    views[min(absent, count - 1)]["means"] = None
    views[0]["mlp.1"][0] = float("nan")
    grown = aggregate(Sum(), DenseGradients(views, BLOCKS)).gradients
    mean = build("operators", "mean", {})
    for gradients in (
        DenseGradients(views, BLOCKS),
        DenseGradients(list(map(copied, views)), BLOCKS, overwrite=True),
        accumulation(views),
        SummedGradients(copied(grown), BLOCKS, count),
    ):
        found = aggregate(mean, gradients).gradients
        for name, total in grown.items():
            assert (found[name] is None) == (total is None)
            assert total is None or torch.equal(found[name], total / count), name


def test_an_accumulated_sum_that_was_read_is_not_changed_by_its_mean():
    views = make_views(3)
    gradients = accumulation(views)
    total = {name: gradient.clone() for name, gradient in gradients.total().items()}
    mean = gradients.total(3)
    for name, expected in total.items():
        assert torch.equal(gradients.total()[name], expected)
        assert torch.equal(mean[name], expected / 3)


def test_an_accumulated_sum_cannot_be_read_after_it_was_divided():
    gradients = accumulation(make_views(2))
    mean = gradients.total(2)
    assert gradients.total(2) is mean
    with pytest.raises(RuntimeError, match="their mean has overwritten it"):
        gradients.total()
    with pytest.raises(RuntimeError, match="more views were rendered than the 2"):
        gradients.add(make_views(1)[0])


def test_aggregate_equals_the_default_gramian_aggregation():
    gradients = DenseGradients(make_views(2), BLOCKS)
    found = aggregate(Symmetric(), gradients)
    context = AggregateContext(
        step=1,
        schedule=None,
        scene=None,
        states={},
        rng=np.random.default_rng(0),
        gradients=gradients,
        losses=np.ones(2),
        labels=None,
        distances=np.ones(2),
        reference_distance=1.0,
        blocks=BLOCKS,
    )
    direct, _ = aggregate_by_gramians(Symmetric(), "block", context, EMPTY_STATE)
    assert all(torch.equal(found.gradients[n], direct.gradients[n]) for n in SHAPES)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("bad", [None, "first", "middle", "last", "all"])
def test_deferred_sums_equal_immediate_sums(count, bad):
    """Compare the omitted views, the views counted as present, the sum and the mean."""
    views = make_views(count)
    views[0]["scales"].zero_()
    views[-1]["opacities"] = None
    hit = {None: [], "first": [0], "middle": [count // 2], "last": [-1], "all": range(count)}[bad]
    for k in hit:
        views[k]["mlp.1"][2] = torch.nan
        views[k]["means"][3, 1] = torch.inf
    now, late = accumulation(views), DeferredSums(BLOCKS, count)
    for view in views:
        late.add(copied(view))
    assert late.views == count
    np.testing.assert_array_equal(late.finite(), now.finite())
    np.testing.assert_array_equal(late.present(), now.present())
    for divisor in (1, count):
        expected, found = accumulation(views).total(divisor), late.total(divisor)
        assert set(found) == set(SHAPES)
        for name, tensor in found.items():
            other = expected.get(name)
            assert (tensor is None) == (other is None), name
            if tensor is not None:
                torch.testing.assert_close(tensor, other, rtol=1e-6, atol=1e-6)


def test_deferred_sums_refuse_more_views_than_announced():
    late = DeferredSums(BLOCKS, 1)
    late.add(make_views(1)[0])
    with pytest.raises(RuntimeError, match="more views were rendered than the 1"):
        late.add(make_views(1)[0])


def summed(views):
    gradients = SummedGradients.empty(BLOCKS, len(views))
    for view in views:
        gradients.add({name: tensor.clone() for name, tensor in view.items()})
    return gradients


def test_the_gradient_of_one_view_is_checked_again_only_after_a_write():
    (view,) = make_views(1)
    view["scales"][3, 1] = torch.inf
    gradients = summed([view])
    total = gradients.total(1)
    assert total["scales"] is None
    assert all(gradients.is_judged(n, total[n]) for n in SHAPES if n != "scales")
    assert not gradients.is_judged("means", total["opacities"])
    assert not gradients.is_judged("means", total["means"].clone())
    assert not gradients.is_judged("scales", view["scales"])
    total["means"].mul_(torch.inf)
    assert not gradients.is_judged("means", total["means"])


def test_sums_of_several_views_are_checked_again_because_they_may_overflow():
    gradients = summed(make_views(2))
    assert not any(gradients.is_judged(name, g) for name, g in gradients.total(2).items())
    (view,) = make_views(1)
    joint = SummedGradients(view, BLOCKS, 2)
    assert joint.is_judged("means", joint.total(1)["means"])


def test_sparse_rows_of_one_view_are_not_checked_twice():
    (view,) = make_views(1)
    rows, values = torch.tensor([3, 8]), torch.ones(2, 3)
    gradients = summed([{**view, "means": sparse_rows(rows, values, (50, 3))}])
    total = gradients.total(1)
    assert gradients.is_judged("means", total["means"])
    assert not gradients.is_judged("means", sparse_rows(rows, values.clone(), (50, 3)))
    assert not gradients.is_judged("means", total["means"].to_dense())
    values_of(total["means"]).mul_(torch.inf)
    assert not gradients.is_judged("means", total["means"])
