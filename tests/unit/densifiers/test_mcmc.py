"""3DGS-MCMC against its rules, worked out primitive by primitive."""

from collections import Counter
from dataclasses import replace
from math import exp, log

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    NO_EDIT,
    Edit,
    apply_to_moment,
    apply_to_parameters,
)
from crossgrad_core.contract.contexts import AfterStepContext, DensifyContext, RegularizeContext
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.errors import IncompatibleSelectionError
from crossgrad_core.run import assemble as assembling
from crossgrad_core.run import select as selecting
from crossgrad_core.testing.fixtures import sample_gaussians, sample_scene, step_fields
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.densifiers.mcmc import (
    MarkovChainMonteCarlo,
    drawn,
    shared_opacity,
    shared_scale,
)

MEANS_LR = 1e-4


def parameters(opacities, seed=0):
    rng = np.random.default_rng(seed)
    n = len(opacities)
    tensors = {
        "means": rng.normal(size=(n, 3)),
        "scales": rng.normal(-4.0, 1.0, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "opacities": np.array([log(o / (1 - o)) for o in opacities]),
        "f_dc": rng.normal(size=(n, 1, 3)),
        "f_rest": rng.normal(size=(n, 15, 3)),
    }
    return {name: torch.from_numpy(t).float().requires_grad_() for name, t in tensors.items()}


def densify_context(params, *, step=600, room=10**6, rng=0):
    fields = {**step_fields(step), "rng": np.random.default_rng(rng)}
    return DensifyContext(
        **fields, parameters=params, backbone=Vanilla(), rasterizer=None, views=(),
        means_lr=MEANS_LR, room=room,
    )  # fmt: skip


def after_step(params, rng=0, densifier=None):
    fields = {**step_fields(1), "rng": np.random.default_rng(rng)}
    context = AfterStepContext(
        **fields, parameters=params, backbone=Vanilla(), means_lr=MEANS_LR, edited=False
    )
    return (densifier or MarkovChainMonteCarlo()).crossgrad_after_step(context)


def edited(params, edit):
    return apply_to_parameters(edit, Vanilla().blocks(), params)


def mixed(n=60, dead=20, seed=1):
    rng = np.random.default_rng(seed)
    opacities = np.concatenate([rng.uniform(1e-4, 0.0049, dead), rng.uniform(0.1, 0.99, n - dead)])
    return rng.permutation(opacities).tolist()


def test_dead_gaussians_move_onto_live_gaussians_and_all_copies_share_the_opacity():
    opacities = mixed()
    params = parameters(opacities)
    edit, _ = MarkovChainMonteCarlo(growth=0).densify(densify_context(params), EMPTY_STATE)
    dead = [i for i, o in enumerate(opacities) if o <= 0.005]
    source = edit.source.tolist()
    assert dict(edit.counts) == {"relocated": len(dead), "added": 0}
    assert [i for i in range(60) if source[i] != i] == dead
    assert not set(source) & set(dead)
    new, copies = edited(params, edit), Counter(source)
    for i, origin in enumerate(source):
        n = copies[origin]
        assert edit.fresh[i].item() == (n > 1)
        for name in ("means", "quats", "f_dc", "f_rest"):
            assert torch.equal(new[name][i], params[name][origin])
        o = torch.sigmoid(params["opacities"][origin].detach().double())[None]
        each, scale = shared_opacity(o, torch.tensor([n])), shared_scale(o, torch.tensor([n]))
        assert torch.sigmoid(new["opacities"][i]).item() == pytest.approx(each.item(), rel=1e-5)
        shrunk = new["scales"][i] - params["scales"][origin]
        assert shrunk.tolist() == pytest.approx([log(scale.item())] * 3, abs=1e-6)


def test_growth_adds_five_percent_and_clears_the_moments_of_changed_rows():
    params = parameters([0.5] * 100)
    edit, _ = MarkovChainMonteCarlo().densify(densify_context(params), EMPTY_STATE)
    source = edit.source.tolist()
    assert source[:100] == list(range(100)) and len(source) == 105
    touched = {i for i, origin in enumerate(source) if Counter(source)[origin] > 1}
    moment = apply_to_moment(edit, "means", torch.ones(100, 3))
    assert {i for i in range(105) if not moment[i].any()} == touched
    assert {i for i in range(105) if moment[i].all()} == set(range(105)) - touched


@pytest.mark.parametrize(
    ("cap", "room", "added", "held_back"),
    [(10**6, 10**6, 10, None), (203, 10**6, 3, None), (150, 10**6, 0, None), (10**6, 4, 4, 6),
     (10**6, 0, 0, 10), (203, 2, 2, 1)],
)  # fmt: skip
def test_the_cap_and_the_primitive_limit_bound_the_growth(cap, room, added, held_back):
    params = parameters([0.5] * 200)
    densifier = MarkovChainMonteCarlo(cap=cap)
    edit, _ = densifier.densify(densify_context(params, room=room), EMPTY_STATE)
    if added == 0 and held_back is None:
        assert edit == NO_EDIT
        return
    assert (0 if edit.source is None else edit.source.shape[0] - 200) == added
    assert edit.counts.get("held_back") == held_back


def test_source_gaussians_are_sampled_in_proportion_to_their_opacity():
    weights = torch.tensor([0.0, 0.1, 0.3, 0.6, 0.0], dtype=torch.float64)
    counts = np.bincount(drawn(weights, 20_000, np.random.default_rng(0)).numpy(), minlength=5)
    expected = 20_000 * weights.numpy()
    assert counts[[0, 4]].tolist() == [0, 0]
    # Three standard deviations of a binomial count.
    assert (np.abs(counts - expected) <= 3 * np.sqrt(expected) + 1e-9).all()


@pytest.mark.parametrize("logit", [-1e3, -30.0, -8.0, 30.0, 1e3])
def test_extreme_opacities_give_finite_values(logit):
    params = parameters([0.5] * 30)
    with torch.no_grad():
        params["opacities"][:20] = logit
    edit, _ = MarkovChainMonteCarlo(growth=1).densify(densify_context(params), EMPTY_STATE)
    new = edited(params, edit)
    assert all(tensor.isfinite().all() for tensor in new.values())
    assert new["means"].shape[0] == 60


def test_no_edit_happens_if_all_gaussians_are_dead_or_between_the_edit_steps():
    params = parameters([0.5] * 30)
    with torch.no_grad():
        params["opacities"][:] = -1e4
    densifier = MarkovChainMonteCarlo()
    assert densifier.densify(densify_context(params), EMPTY_STATE)[0] == NO_EDIT
    params = parameters(mixed())
    assert densifier.densify(densify_context(params, step=601), EMPTY_STATE)[0] == NO_EDIT


@pytest.mark.parametrize(("mode", "total"), [("scaled", 30_000), ("absolute", 7_000)])
def test_edits_happen_from_step_500_to_step_25_000_of_30_000_without_resets(mode, total):
    window = MarkovChainMonteCarlo().window(Schedule.for_run(total, mode))
    assert (window.densify_from, window.densify_until, window.densify_every) == (500, 25_000, 100)
    assert window.reset_every is None
    assert window.densifies(600) and window.densifies(24_900) and not window.densifies(25_000)


def test_a_run_starts_with_half_opaque_and_small_gaussians():
    before = parameters([0.1] * 5)
    after = MarkovChainMonteCarlo().started(before)
    assert torch.sigmoid(after["opacities"]).tolist() == pytest.approx([0.5] * 5)
    assert torch.exp(after["scales"]).tolist() == [
        pytest.approx(row) for row in (0.1 * torch.exp(before["scales"])).tolist()
    ]
    kept = MarkovChainMonteCarlo(initial_opacity=None, initial_scale=1).started(before)
    assert all(torch.equal(kept[name], before[name]) for name in before)


def test_noise_agrees_with_the_formula_row_by_row():
    opacities = [0.001, 0.005, 0.02, 0.05, 0.1]
    params = parameters(opacities)
    answer = after_step(params, rng=5)
    rows = answer.edit.values["means"]
    draws = np.random.default_rng(5).standard_normal((5, 3), dtype=np.float32).astype(float)
    assert rows.rows.tolist() == [0, 1, 2, 3, 4] and rows.keep_moments
    for i, o in enumerate(opacities):
        w, x, y, z = params["quats"][i].tolist()
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        variance = np.diag(np.exp(2 * params["scales"][i].detach().double().numpy()))
        gate = 1 / (1 + exp(100 * (o - 0.005)))
        shift = turn @ variance @ turn.T @ draws[i] * gate * MEANS_LR * 5e5
        found = (rows.values[i] - params["means"][i]).detach().numpy()
        # The sum with the mean is rounded to float32.
        assert found == pytest.approx(shift, rel=1e-4, abs=2.0**-22)


def test_noise_below_float_rounding_is_not_sampled():
    params = parameters([0.9, 0.01, 0.5])
    with torch.no_grad():
        params["scales"][:] = log(0.01)
    assert after_step(params).edit.values["means"].rows.tolist() == [1]
    # What was left out is below a rounding of the Gaussian's own size.
    gate = 1 / (1 + exp(100 * (0.5 - 0.005)))
    assert gate * MEANS_LR * 5e5 * 0.01 < 2.0**-23
    assert after_step(parameters([0.9] * 4)) is None
    assert after_step(parameters([0.01] * 4), densifier=MarkovChainMonteCarlo(noise=0)) is None


@pytest.mark.parametrize(("scale", "opacity"), [(40.0, -40.0), (-60.0, -60.0), (-60.0, 60.0)])
def test_noise_of_extreme_gaussians_is_finite(scale, opacity):
    params = parameters([0.01] * 4)
    with torch.no_grad():
        params["scales"][:], params["opacities"][:] = scale, opacity
        params["quats"][0] = 0.0
    answer = after_step(params)
    if answer is not None:
        assert answer.edit.values["means"].values.isfinite().all()


def test_noise_changes_means_only_and_is_repeatable():
    params = parameters([0.01] * 6)
    one, other = after_step(params, rng=3).edit, after_step(params, rng=3).edit
    assert set(one.values) == {"means"} and one.source is None
    assert torch.equal(one.values["means"].values, other.values["means"].values)
    moment = torch.ones(6, 3)
    assert torch.equal(apply_to_moment(one, "means", moment), moment)


def regularize_context(params, gaussians=None):
    return RegularizeContext(
        **step_fields(1), parameters=params, backbone=Vanilla(), gaussians=gaussians, view=None
    )


def test_regularizers_are_means_and_apply_once_per_step():
    params = parameters([0.2, 0.7])
    densifier = MarkovChainMonteCarlo(opacity_weight=0.03, scale_weight=0.5)
    loss = densifier.crossgrad_regularize(regularize_context(params)).loss
    scales = np.exp(params["scales"].detach().double().numpy())
    assert loss.item() == pytest.approx(0.03 * 0.45 + 0.5 * scales.mean(), rel=1e-5)
    loss.backward()
    assert params["opacities"].grad.tolist() == pytest.approx([0.03 * 0.08, 0.03 * 0.105])
    assert params["scales"].grad.numpy() == pytest.approx(0.5 * scales / 6, rel=1e-5)
    per_view = regularize_context(params, sample_gaussians())
    assert densifier.crossgrad_regularize(per_view) is None
    assert densifier.crossgrad_regularize(regularize_context(parameters([]))) is None


EARLY = {"schedule_unit": "steps", "densify_from": 1, "densify_until": 9, "densify_every": 2}


def setup_of(**options):
    config = RunConfig(
        steps=10,
        initializer=ComponentChoice(name="points"),
        densifier=ComponentChoice(name="mcmc", **options),
        **EARLY,
    )
    return assembling.assemble(config, sample_scene(), "none")


def trained(setup, steps=6):
    state = first_state(setup)
    records = [timed_step(setup, state) for _ in range(steps)]
    return state.parameters, records


def test_hooks_of_the_mcmc_densifier_take_effect_in_a_run():
    # The scene has 40 points: growth by half, so that there is some.
    quiet = {"noise": 0.0, "opacity_weight": 0.0, "scale_weight": 0.0, "growth": 0.5}
    silent = setup_of(**quiet)
    assert silent.regularizes and silent.acts_after_step
    start = first_state(silent).parameters
    assert torch.sigmoid(start["opacities"]).tolist() == pytest.approx([0.5] * 40)
    plain, records = trained(silent)
    assert [r.counts.get("added") for r in records] == [None, 20, None, 30, None, 45]
    decayed, _ = trained(setup_of(**{**quiet, "opacity_weight": 10.0}))
    assert decayed["opacities"].mean() < plain["opacities"].mean()
    shrunk, _ = trained(setup_of(**{**quiet, "scale_weight": 100.0}))
    assert shrunk["scales"].mean() < plain["scales"].mean()
    # At the start all are half opaque: only a loud noise shows.
    moved, _ = trained(setup_of(**{**quiet, "noise": 1e30}), steps=1)
    still, _ = trained(silent, steps=1)
    assert not torch.equal(moved["means"], still["means"])
    assert torch.equal(moved["scales"], still["scales"])


class WithoutOpacities(Vanilla):
    def blocks(self):
        return tuple(block for block in super().blocks() if block.name != "opacities")


def test_a_backbone_without_opacities_is_refused_with_the_reason(monkeypatch):
    build = selecting.build

    def with_other_backbone(slot, name, options):
        return WithoutOpacities() if slot is Backbone else build(slot, name, options)

    monkeypatch.setattr(selecting, "build", with_other_backbone)
    with pytest.raises(IncompatibleSelectionError, match="cannot work together") as refused:
        setup_of()
    assert "densifier mcmc edits the tensors opacities" in refused.value.found


def test_densify_does_not_change_its_inputs():
    params = parameters(mixed())
    copies = {name: tensor.detach().clone() for name, tensor in params.items()}
    edit, _ = MarkovChainMonteCarlo().densify(densify_context(params), EMPTY_STATE)
    after_step(params)
    assert isinstance(edit, Edit)
    assert all(torch.equal(params[name], copies[name]) for name in params)
    same, _ = MarkovChainMonteCarlo().densify(densify_context(params), EMPTY_STATE)
    assert torch.equal(same.source, edit.source)
    other = replace(densify_context(params), rng=np.random.default_rng(1))
    again, _ = MarkovChainMonteCarlo().densify(other, EMPTY_STATE)
    assert not torch.equal(again.source, edit.source)
