"""Agreement with TorchJD 0.18 on well-scaled Gramians, and the adapter to it."""

from functools import partialmethod

import cvxpy
import numpy as np
import pytest
import torch
from torchjd import aggregation
from torchjd.linalg import QuadprogProjector

from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build

TOLERANCE = 1e-6
VIEWS = (2, 3, 4, 6)
#: As far as Clarabel goes. An optimum is flat, so a gap of 1e-8 (the default) leaves 5e-5 in the
#: weights; shorter steps keep the interior-point method from stalling at the edge.
TIGHT = {
    "tol_gap_abs": 1e-15,
    "tol_gap_rel": 1e-15,
    "tol_feas": 1e-15,
    "max_step_fraction": 0.9,
}


def gradients(views, count=20):
    rng = np.random.default_rng(views)
    for _ in range(count):
        yield rng.standard_normal((views, 24)) * rng.uniform(0.5, 2, (views, 1)) - 0.1


def agree(name, weighting, views, ask):
    for rows in gradients(views):
        gramian = rows @ rows.T
        expected = weighting(torch.from_numpy(gramian / np.trace(gramian))).numpy()
        found = ask(name, rows).weights
        np.testing.assert_allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.parametrize(
    ("name", "weighting"),
    [("sum", "Sum"), ("mean", "Mean"), ("imtl-g", "IMTLG"), ("aligned", "AlignedMTL")],
)
def test_closed_form_methods_agree_with_torchjd(name, weighting, views, ask):
    agree(name, getattr(aggregation, f"{weighting}Weighting")(), views, ask)


@pytest.mark.parametrize(("name", "weighting"), [("pcgrad", "PCGrad"), ("gradvac", "GradVac")])
def test_pairwise_methods_agree_with_torchjd_for_two_views(name, weighting, ask):
    for rows in gradients(2):
        gramian = rows @ rows.T
        fresh = getattr(aggregation, f"{weighting}Weighting")()
        expected = fresh(torch.from_numpy(gramian / np.trace(gramian))).numpy()
        np.testing.assert_allclose(ask(name, rows).weights, expected, rtol=TOLERANCE)


@pytest.mark.parametrize("beta", [0.3, 0.5])
def test_gradvac_follows_the_target_cosines_of_torchjd(beta, ask):
    operator = build("operators", "gradvac", {"beta": beta})
    theirs = aggregation.GradVacWeighting(beta=beta)
    state = None
    for rows in gradients(2, 40):
        gramian = rows @ rows.T
        expected = theirs(torch.from_numpy(gramian / np.trace(gramian))).numpy()
        found = ask(operator, rows, **({} if state is None else {"state": state}))
        state = found.state
        np.testing.assert_allclose(found.weights, expected, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("views", VIEWS)
def test_mgda_is_at_least_as_good_as_torchjd(views, ask):
    """The Frank-Wolfe steps of TorchJD shrink slowly, so its result is longer.

    For the shortest point u of a convex set and any other point v, |v - u|^2 <= |v|^2 - |u|^2.
    """
    theirs = aggregation.MGDAWeighting(epsilon=1e-14, max_iters=1000)
    for rows in gradients(views, 5):
        gramian = rows @ rows.T
        expected = theirs(torch.from_numpy(gramian / np.trace(gramian))).numpy() @ rows
        found = ask("mgda", rows).result
        excess = expected @ expected - found @ found
        assert excess <= (1e-13 if views == 2 else 0.02) * (expected @ expected)
        assert ((found - expected) ** 2).sum() <= excess + 1e-12 * (expected @ expected)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("views", VIEWS)
def test_mgda_agrees_with_torchjd_if_every_view_has_a_positive_weight(views, ask):
    """The Frank-Wolfe method converges fast if the shortest point is far inside the convex hull."""
    theirs = aggregation.MGDAWeighting(epsilon=1e-16, max_iters=1000)
    compared = 0
    for rows in gradients(views):
        found = ask("mgda", rows).weights
        if found.min() > 0.09:
            gramian = rows @ rows.T
            expected = theirs(torch.from_numpy(gramian / np.trace(gramian))).numpy()
            np.testing.assert_allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE)
            compared += 1
    assert compared


@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.parametrize(("name", "weighting"), [("upgrad", "UPGrad"), ("dualproj", "DualProj")])
def test_cone_projections_agree_with_torchjd(name, weighting, views, ask):
    projector = QuadprogProjector(norm_eps=1e-12, reg_eps=1e-10)
    agree(name, getattr(aggregation, f"{weighting}Weighting")(projector=projector), views, ask)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_cagrad_agrees_with_torchjd_with_a_tight_solver(views, ask, monkeypatch):
    """The solver warns that it does not reach its tolerance of 1e-15."""
    solve = partialmethod(cvxpy.Problem.solve, **TIGHT)
    monkeypatch.setattr(cvxpy.Problem, "solve", solve)
    agree("cagrad", aggregation.CAGradWeighting(c=0.5, norm_eps=1e-12), views, ask)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("views", VIEWS)
def test_cagrad_is_never_worse_than_torchjd_with_default_solver(views, ask):
    """The default solver of TorchJD is accurate to about 6e-5.

    Both results are within c |g_0| of the mean. TorchJD never serves the worst view better.
    """
    theirs = aggregation.CAGradWeighting(c=0.5, norm_eps=1e-12)
    for rows in gradients(views):
        gramian = rows @ rows.T
        expected = theirs(torch.from_numpy(gramian / np.trace(gramian))).numpy() @ rows
        found = ask("cagrad", rows).result
        mean = rows.mean(axis=0)
        radius = 0.5 * np.linalg.norm(mean)
        assert np.linalg.norm(found - mean) <= radius * (1 + 1e-12)
        assert (rows @ expected).min() <= (rows @ found).min() + 1e-12 * np.trace(gramian)
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.linalg.norm(expected))


def test_the_adapter_does_not_depend_on_scale_and_ignores_zero_views(ask):
    rows = np.random.default_rng(0).standard_normal((3, 8))
    rows[1] = 0
    plain = ask("torchjd", rows).weights
    np.testing.assert_allclose(ask("torchjd", 1e-12 * rows).weights, plain, rtol=1e-12)
    np.testing.assert_allclose(plain[[0, 2]], ask("torchjd", rows[[0, 2]]).weights)
    assert plain[1] == 0


def test_the_adapter_passes_options_and_does_not_use_the_global_generator(ask):
    operator = build("operators", "torchjd", {"weighting": "Krum", "options": {"n_byzantine": 0}})
    assert hash(operator) == hash(type(operator).model_validate(operator.model_dump(mode="json")))
    rows = np.random.default_rng(0).standard_normal((4, 8))
    before = torch.get_rng_state()
    ask(operator, rows)
    one = ask(build("operators", "torchjd", {"weighting": "PCGrad"}), rows, seed=5).weights
    two = ask(build("operators", "torchjd", {"weighting": "PCGradWeighting"}), rows, seed=5).weights
    np.testing.assert_array_equal(one, two)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"weighting": "PCGard"}, "no weighting named"),
        ({"weighting": "GradVac"}, "could not be resumed"),
        ({"weighting": "MGDA", "options": {"speed": 3}}, "cannot be created"),
        ({"weighting": "ConstantWeighting"}, "cannot be created"),
    ],
)
def test_the_adapter_refuses_unusable_weightings(options, reason, ask):
    with pytest.raises(UserError, match=reason):
        ask(build("operators", "torchjd", options), np.eye(2))


def test_the_adapter_names_the_package_to_install(monkeypatch, ask):
    monkeypatch.setitem(__import__("sys").modules, "torchjd", None)
    with pytest.raises(UserError, match=r"crossgrad\[torchjd\]"):
        ask("torchjd", np.eye(2))
