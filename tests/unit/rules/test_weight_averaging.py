"""Rates that fade at the end of a run, and the average of its last parameters."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import EMPTY_STATE, Edit, LearningRate, PluginState, Rows
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.export import renderer
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import step as stepping
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.rules import eval_parameters, rate_factor
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import Snapshot, TrainState
from crossgrad_plugins.rules.weight_averaging import NAME, WeightAveraging

CONSTANT, DECAYING = LearningRate(0.05), LearningRate(1.0, 0.01)
STEPS = 10
BACKBONES = sorted(n for n, e in entries("backbones").items() if e.distribution == "crossgrad")
#: On a scene of forty points the published cells of anchors would hold nothing.
OPTIONS = {"scaffold": {"voxel_size": 1e-5}, "octree": {}}


def setup_of(backbone="vanilla", densifier="none", **settings):
    choice = {"name": backbone, **OPTIONS.get(backbone, {})}
    given = {
        "steps": STEPS,
        "backbone": ComponentChoice.model_validate(choice),
        "densifier": ComponentChoice(name=densifier),
        **settings,
    }
    return assemble(RunConfig(**given), sample_scene(), "none")


def using(rule, **options):
    """The settings of a run that uses a rule."""
    return {"rules": {rule: options}}


def trained(setup, steps=STEPS, state=None):
    """The state after some steps, and the parameters after each of them."""
    state = state or first_state(setup)
    seen = []
    while state.step < steps:
        timed_step(setup, state)
        seen.append({n: t.detach().clone() for n, t in state.parameters.items()})
    return state, seen


def same(one, two):
    return one.keys() == two.keys() and all(torch.equal(one[n], two[n]) for n in one)


@pytest.mark.parametrize(
    ("share", "step", "left"),
    [
        (0.2, 800, 1.0),
        (0.2, 900, 0.1),
        (0.2, 950, 0.01**0.75),
        (0.2, 1000, 0.01),
        (1.0, 500, 0.1),
        (1.0, 1, 0.01**0.001),
        (1e-17, 999, 1.0),
        (1e-17, 1000, 1.0),
        (1e-9, 999, 1.0),
        (1e-9, 1000, 0.01),
    ],
)
def test_constant_learning_rates_decay_log_linearly_over_the_last_share(share, step, left):
    setup = setup_of(**using("lr-tail", share=share), steps=1000)
    assert rate_factor(setup, CONSTANT, step) == pytest.approx(left, rel=1e-12)
    assert rate_factor(setup, DECAYING, step) == 1.0
    assert rate_factor(setup, LearningRate(0.3, 0.3), step) == pytest.approx(left, rel=1e-12)


def test_the_final_factor_of_the_learning_rate_is_an_option():
    setup = setup_of(**using("lr-tail", share=0.5, factor=0.25), steps=100)
    assert rate_factor(setup, CONSTANT, 100) == 0.25
    assert rate_factor(setup, CONSTANT, 75) == 0.5


def recorded(setup):
    """The state after a run, the parameters after each step, and the rates of each."""
    rates, real = [], stepping.adam_step

    def adam_step(params, grads, state, lrs, *more, **named):
        rates.append(dict(lrs))
        real(params, grads, state, lrs, *more, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stepping, "adam_step", adam_step)
        return *trained(setup), rates


@pytest.fixture(scope="module", params=BACKBONES)
def runs(request):
    """Runs of a backbone: as published, averaged, and with both; the last one also in two parts."""
    setups = {
        "plain": setup_of(request.param, rules={"lr-tail": False}),
        "averaged": setup_of(request.param, rules={NAME: {"share": 0.4}, "lr-tail": False}),
        "both": setup_of(request.param, rules={NAME: {"share": 0.5}, "lr-tail": {"share": 0.5}}),
    }
    found = {name: recorded(setup) for name, setup in setups.items()}
    half, _ = trained(setups["both"], steps=7)
    again = from_checkpoint(setups["both"], to_checkpoint(half))
    return SimpleNamespace(setups=setups, again=trained(setups["both"], state=again)[0], **found)


@pytest.mark.sampled(1)
def test_learning_rates_equal_the_published_rates_until_they_decay(runs):
    blocks = runs.setups["plain"].trained_blocks
    of = {name: block.lr for block in blocks for name in block.tensors}
    published, fading = runs.plain[2], runs.both[2]
    assert len(published) == len(fading) == STEPS
    for step, (plain, faster) in enumerate(zip(published, fading, strict=True), start=1):
        for name, rate in of.items():
            left = 1.0 if rate.decays else 0.01 ** max(0.0, (step - 5) / 5)
            assert faster[name] == pytest.approx(plain[name] * left, rel=1e-12)
            if step <= STEPS / 2:
                assert faster[name] == plain[name]
    constant = [name for name, rate in of.items() if not rate.decays]
    assert constant and all(published[0][n] == published[-1][n] for n in constant)


@pytest.mark.sampled(3)
def test_the_average_of_parameters_covers_the_last_steps_and_does_not_change_training(runs):
    (plain, _, _), (state, seen, _) = runs.plain, runs.averaged
    assert same(plain.parameters, state.parameters)
    assert NAME not in plain.states
    assert state.states[NAME].values["count"] == 4
    found = eval_parameters(runs.setups["averaged"], state)
    assert found.keys() == state.parameters.keys()
    averaged = {n for block in runs.setups["averaged"].trained_blocks for n in block.tensors}
    for name, tensor in found.items():
        if name in averaged:
            expected = torch.stack([each[name].double() for each in seen[-4:]]).mean(dim=0)
            assert torch.allclose(tensor.double(), expected, rtol=1e-6, atol=1e-7)
        else:
            assert tensor is state.parameters[name]


def test_evaluation_renders_the_averaged_parameters(runs):
    setup, state = runs.setups["averaged"], runs.averaged[0]
    view = sample_scene().test_views[0]
    raw = TrainState(state.parameters, state.adam, state.rngs, step=state.step)
    mean = TrainState(eval_parameters(setup, state), state.adam, state.rngs, step=state.step)
    with torch.no_grad():
        drawn, expected, other = (renderer(setup, s)(view) for s in (state, mean, raw))
    assert torch.equal(drawn, expected) and not torch.equal(drawn, other)


def test_a_run_resumed_from_a_checkpoint_ends_with_the_same_bits(runs):
    whole = runs.both[0]
    assert same(whole.parameters, runs.again.parameters)
    (one, two) = (each.states[NAME] for each in (whole, runs.again))
    assert one.values == two.values == {"count": 5}
    assert same(one.tensors, two.tensors) and same(one.per_primitive, two.per_primitive)


def test_a_snapshot_keeps_its_average():
    setup = setup_of(**using(NAME, share=1.0))
    state, _ = trained(setup, steps=4)
    before = {name: tensor.clone() for name, tensor in eval_parameters(setup, state).items()}
    snapshot = Snapshot.of(state)
    trained(setup, steps=8, state=state)
    snapshot.hand_over(state)
    assert state.step == 4 and same(eval_parameters(setup, state), before)


class Counted:
    """A run of one tensor, to count the steps of an average."""

    def __init__(self, total, share):
        block = SimpleNamespace(tensors=("x",), per_primitive=False)
        self.backbone = SimpleNamespace(trained_blocks=lambda: (block,))
        self.rule, self.edited = WeightAveraging(share=share), False
        self.schedule = SimpleNamespace(total=total)
        self.step, self.parameters, self.held = 0, {"x": torch.zeros(1)}, EMPTY_STATE

    def state(self, name):
        assert name == NAME
        return self.held

    def take(self, step):
        """Take a step; whether it changed the average."""
        self.step = step
        answer = self.rule.crossgrad_step_done(self)
        if answer is not None:
            self.held = answer.states[NAME]
        return answer is not None


@pytest.mark.parametrize(
    ("total", "share", "count"),
    [
        (10, 0.9, 9),
        (400, 0.1, 40),
        (400, 0.25, 100),
        (1000, 1.0, 100),
        (1001, 0.1, 51),
        (1490, 0.1, 75),
        (30_000, 0.1, 100),
        (30_000, 0.5, 100),
    ],
)
def test_at_most_a_hundred_states_including_the_last_are_averaged(total, share, count):
    run = Counted(total, share)
    taken = [step for step in range(1, total + 1) if run.take(step)]
    assert len(taken) == run.held.values["count"] == count
    assert taken[-1] == total and taken[0] > (1 - share) * total
    assert len(set(np.diff(taken))) == 1


def test_no_combination_of_length_and_share_averages_more_than_a_hundred_states():
    for total in (99, 100, 1000, 1490, 2001):
        for share in np.linspace(0.01, 1.0, 12):
            window = sum(step > (1.0 - share) * total for step in range(1, total + 1))
            run = Counted(total, float(share))
            taken = sum(map(run.take, range(1, total + 1)))
            assert min(window, 50) <= taken <= 100


def test_sums_of_many_states_keep_their_precision():
    run = Counted(10_000, 1.0)
    for step in range(1, 10_001):
        run.parameters = {"x": torch.tensor([1.0 + 1e-3 * np.sin(step / 100)])}
        run.take(step)
    steps = np.arange(100, 10_001, 100)
    expected = np.mean(1.0 + 1e-3 * np.sin(steps / 100))
    shown = run.rule.crossgrad_eval_parameters({NAME: run.held})
    assert float(shown["x"]) == pytest.approx(expected, abs=1e-6)


def test_a_longer_length_discards_an_average_that_began_too_early():
    run = Counted(100, 0.1)
    for step in range(1, 96):
        run.take(step)
    assert run.held.values["count"] == 5
    run.schedule = SimpleNamespace(total=200)
    assert run.take(96) and not run.held.values
    assert run.rule.crossgrad_eval_parameters({NAME: run.held}) is None


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("edit", "count"),
    [
        (lambda p: Edit(source=torch.arange(len(p["means"]) - 1)), 3),
        (lambda p: Edit(source=torch.arange(len(p["means"])).flip(0)), 3),
        (lambda p: Edit(values={"opacities": Rows(p["opacities"].detach() - 1.0)}), 3),
        (lambda p: Edit(), 6),
        (lambda p: Edit(counts={"held_back": 2}), 6),
    ],
    ids=["fewer", "other-order", "reset", "nothing", "a-count"],
)
def test_an_edit_of_density_control_restarts_the_average(edit, count, monkeypatch):
    """The last six of ten steps are averaged, and the edit happens in step 8."""
    setup = setup_of(**using(NAME, share=0.6))

    def densify(self, context, state):
        answer = edit(context.parameters) if context.step == 8 else Edit()
        return answer, PluginState()

    monkeypatch.setattr(type(setup.densifier), "densify", densify)
    state, seen = trained(setup)
    assert state.states[NAME].values["count"] == count
    expected = torch.stack([each["opacities"] for each in seen[-count:]]).mean(dim=0)
    assert torch.allclose(eval_parameters(setup, state)["opacities"], expected, atol=1e-6)


def test_noise_after_every_step_does_not_restart_the_average():
    setup = setup_of(densifier="mcmc", densify_until=2, **using(NAME, share=0.5))
    state, _ = trained(setup)
    assert state.states[NAME].values["count"] == 5


def test_the_published_recipe_has_no_learning_rate_tail_and_no_averaging():
    published = {"recipe": {"name": "published"}}
    assert resolved(setup_of(**published)).rules == {}
    both = {"lr-tail": {"share": 0.2}, NAME: {"share": 0.1}}
    wanted = {"lr-tail": {"share": 0.2, "factor": 0.01}, NAME: {"share": 0.1}}
    assert resolved(setup_of(**published, rules=both)).rules == wanted


def test_the_configuration_of_a_run_without_constant_learning_rates_repeats_the_run():
    names = ("lr_features_final", "lr_scales_final", "lr_cov_final")
    config = RunConfig(
        steps=10, backbone=ComponentChoice(name="scaffold", **dict.fromkeys(names, 1e-5))
    )
    setup = assemble(config, sample_scene(), "none")
    written = resolved(setup)
    assert written.rules["lr-tail"] is False
    again = RunConfig.model_validate(written.model_dump() | {"reader": {"name": "auto"}})
    assert resolved(assemble(again, sample_scene(), "none")).rules == written.rules


def test_a_run_reports_the_learning_rate_tail():
    shown = {row.setting: row.value for row in setup_of().decisions if row.override}
    assert shown["rules.lr-tail"] == {"share": 0.25}
    without = setup_of(rules={"lr-tail": False})
    assert "rules.lr-tail" not in {row.setting for row in without.decisions}


def test_an_average_with_another_number_of_primitives_is_refused():
    setup = setup_of(**using(NAME, share=0.5))
    state, _ = trained(setup, steps=2)
    state.commit({NAME: PluginState({"count": 2}, {}, {"means": torch.zeros(1, 3)})})
    with pytest.raises(UserError, match="does not match the run"):
        from_checkpoint(setup, to_checkpoint(state))


@pytest.mark.parametrize("sums", [{"gone": torch.zeros(1)}, {"means": torch.zeros(1)}], ids=str)
def test_an_average_of_other_tensors_is_refused(sums):
    setup = setup_of(**using(NAME, share=0.5))
    state, _ = trained(setup, steps=2)
    state.commit({NAME: PluginState({"count": 2}, sums)})
    with pytest.raises(UserError, match="wrong type for the hook crossgrad_eval_parameters"):
        eval_parameters(setup, state)
