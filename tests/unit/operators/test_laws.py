"""Laws of all operators, on drawn gradients of any rank and on fixed ones."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crossgrad_core.registry.entries import build, entries
from crossgrad_operators.stress.suite import LAWS, made

OURS = sorted(n for n, e in entries("operators").items() if e.value.startswith("crossgrad_"))
GRAMIAN = [name for name in OURS if name not in {"graddrop", "torchjd"}]
#: Operators whose result does not depend on the order of the views for any K.
UNORDERED = [
    "sum",
    "mean",
    "cagrad",
    "mgda",
    "imtl-g",
    "nash",
    "aligned",
    "upgrad",
    "dualproj",
    "gradnorm",
    "preconditioner",
]
SCALES = 2.0 ** np.array([-60, 0, 60])
DRAWN = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
@pytest.mark.parametrize("name", OURS)
def test_every_operator_obeys_every_law(name, law):
    error = law(made(name))
    assert error is None or error <= 8


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", GRAMIAN)
@DRAWN
@given(data=st.data())
def test_results_for_any_gradients_are_finite_and_independent_of_scale(
    name, data, ask, gradient_rows
):
    """Results are finite, bounded if promised, and independent of a factor of 2^60 or 2^-60."""
    operator = build("operators", name, {})
    rows = data.draw(gradient_rows())
    if not operator.views.admits(len(rows)):
        return
    before = rows.copy()
    results = [ask(operator, rows * scale).weights for scale in SCALES]
    assert all(np.isfinite(weights).all() for weights in results)
    assert not results[1][~rows.any(axis=1)].any()
    np.testing.assert_array_equal(rows, before)
    for weights in results:
        np.testing.assert_array_equal(weights, results[1])


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", UNORDERED)
@DRAWN
@given(data=st.data())
def test_the_order_of_views_does_not_change_the_result(name, data, ask):
    seed, views = data.draw(st.integers(0, 10_000)), data.draw(st.integers(2, 6))
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((views, 9)) * 10.0 ** rng.uniform(-4, 4, (views, 1))
    labels = tuple("ab"[k % 2] for k in range(views))
    distances = rng.uniform(0.5, 2, views)
    turn = rng.permutation(views)
    one = ask(name, rows, labels=labels, distances=distances)
    turned = tuple(labels[k] for k in turn)
    other = ask(name, rows[turn], labels=turned, distances=distances[turn])
    size = np.abs(one.weights * np.linalg.norm(rows, axis=1)).max()
    np.testing.assert_allclose(one.result, other.result, rtol=0, atol=1e-8 * size)


@pytest.mark.parametrize("name", ["upgrad", "dualproj", "mgda"])
@DRAWN
@given(data=st.data())
def test_the_result_has_no_negative_dot_product_with_any_view(name, data, ask, gradient_rows):
    rows = data.draw(gradient_rows())
    found = ask(name, rows)
    norms = np.linalg.norm(rows, axis=1)
    size = np.abs(found.weights * norms).max()
    assert (rows @ found.result >= -1e-7 * norms * size).all()


@pytest.mark.parametrize("name", ["pcgrad", "gradvac"])
def test_more_than_two_views_are_processed_in_random_order(name, ask):
    rows = np.random.default_rng(1).standard_normal((4, 5)) - 0.3
    results = {ask(name, rows, seed=seed).weights.tobytes() for seed in range(10)}
    assert len(results) > 1
    again = ask(name, rows, seed=3).weights
    np.testing.assert_array_equal(again, ask(name, rows, seed=3).weights)
