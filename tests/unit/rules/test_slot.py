"""Rules are selected by the recipe and by the user, and act through public hooks."""

from copy import deepcopy
from dataclasses import replace
from shlex import split

import pytest
import torch
import yaml
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.contexts import Answer, DensifyResult, ViewSample
from crossgrad_core.contract.decision import Length
from crossgrad_core.contract.slots.rule import FinalEdit, GaussiansResult
from crossgrad_core.errors import UserError
from crossgrad_core.plugin import Edit, PluginState, Rows, Rule, hookimpl
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble, check_names
from crossgrad_core.run.decisions import redecided
from crossgrad_core.run.load_run import from_checkpoint, parsed, to_checkpoint
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.settings import merged
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.rates import rates_at
from crossgrad_core.training.rules import eval_parameters
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import final_edits, take_step
from crossgrad_core.training.views import render_views

OURS = sorted(n for n, e in entries("rules").items() if e.distribution == "crossgrad")


def setup_of(*rules, **settings):
    config = RunConfig.model_validate({"steps": 12, "densifier": {"name": "none"}, **settings})
    setup = assemble(config, sample_scene(), "none")
    return (
        setup.with_rules({f"own{row}": rule for row, rule in enumerate(rules)}) if rules else setup
    )


def file_of(tmp_path, rules):
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump({"rules": rules}), encoding="utf-8")
    return path


def test_a_run_without_rules_trains_and_calls_no_rule_hook():
    setup = setup_of(recipe={"name": "published"})
    assert setup.selection.rules == {} == resolved(setup).rules
    state = first_state(setup)
    before = state.parameters["means"].detach().clone()
    for _ in range(3):
        take_step(setup, state)
    assert not torch.equal(state.parameters["means"], before)
    assert not (setup.gaussians_hooks or setup.optimizer_hooks)
    assert not (setup.changes_rates or setup.follows_steps or setup.update_intervals)
    assert not list(final_edits(setup, state))


def test_a_finished_run_records_all_rules_with_all_options(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    command = ("run", scene, "--steps", 3, "--threads", 1, "--no-rule", "scale-clamp", "--rule")
    more = ("weight-averaging", "--set", "rules.lr-tail.share=0.5", "-q", "--out", tmp_path / "run")
    assert ended(*command, *more) == 0
    written = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text(encoding="utf-8"))
    assert written["rules"]["scale-clamp"] is False
    assert written["rules"]["weight-averaging"] == {"share": 0.2}
    assert written["rules"]["lr-tail"] == {"share": 0.5, "factor": 0.01}
    assert written["rules"]["floaters"] == {"empty": 0.3}
    assert "rules.floaters" in written["decided"] and "rules.lr-tail" not in written["decided"]


def test_the_reported_override_of_a_rule_removes_the_rule():
    setup = setup_of(densifier={"name": "adc"})
    rows = [row for row in setup.decisions if row.setting.startswith("rules.") and row.override]
    assert len(rows) >= 3
    for row in rows:
        option, name = split(row.override)
        assert (option, f"rules.{name}") == ("--no-rule", row.setting)
        config = parsed(merged(None, {"no_rule": [name], "steps": 12}, ()))
        assert name in setup.selection.rules
        assert name not in assemble(config, sample_scene(), "none").selection.rules


@pytest.mark.parametrize(
    ("before", "options", "assignments", "after"),
    [
        ({}, {"rule": ["dropout"]}, [], {"dropout": {}}),
        ({}, {"no_rule": ["dropout", "floaters"]}, [], {"dropout": False, "floaters": False}),
        ({"dropout": {"share": 0.2}}, {"rule": ["dropout"]}, [], {"dropout": {"share": 0.2}}),
        ({"dropout": {"share": 0.2}}, {"no_rule": ["dropout"]}, [], {"dropout": False}),
        ({"dropout": False}, {"rule": ["dropout"]}, [], {"dropout": {}}),
        ({"dropout": False}, {}, ["rules.dropout.share=0.1"], {"dropout": {"share": 0.1}}),
        ({"dropout": True}, {}, ["rules.dropout.share=0.1"], {"dropout": {"share": 0.1}}),
        ({"a": None}, {"rules": {"b": False}}, ["rules.c=true"], {"a": {}, "b": False, "c": {}}),
    ],
)
def test_rules_can_be_added_to_and_removed_from_a_file(
    tmp_path, before, options, assignments, after
):
    assert parsed(merged(file_of(tmp_path, before), options, assignments)).rules == after


def test_a_rule_set_by_the_user_is_no_longer_marked_as_decided(tmp_path):
    path = tmp_path / "config.yaml"
    settings = {"rules": {"dropout": False}, "decided": {"rules.dropout": "many photos"}}
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    for options, assignments in (({"rule": ["dropout"]}, []), ({}, ["rules.dropout.share=0.1"])):
        assert parsed(merged(path, options, assignments)).decided == {}


@pytest.mark.parametrize("value", [0.3, "off", [1]])
def test_an_invalid_value_for_a_rule_is_refused(value):
    with pytest.raises(UserError, match=r"rules\.dropout"):
        parsed({"rules": {"dropout": value}})


@pytest.mark.parametrize("option", ["rule", "no_rule"])
def test_a_misspelt_rule_is_refused_with_the_right_name(option):
    with pytest.raises(UserError, match="did you mean 'floaters'"):
        check_names(parsed(merged(None, {option: ["floater"]}, ())))


def test_an_invalid_option_of_a_rule_is_refused_with_its_name():
    with pytest.raises(UserError) as caught:
        setup_of(rules={"dropout": {"share": 2.0}})
    assert caught.value.where == "rules.dropout.share"


def test_rules_follow_the_length_planned_from_seconds():
    setup = setup_of(steps=None, seconds=60.0, densifier={"name": "adc"})
    assert "scale-clamp" in setup.selection.rules
    for steps, clamps in ((500, True), (40_000, False)):
        planned = redecided(setup, steps)
        assert ("scale-clamp" in planned.selection.rules) == clamps
        assert ("rule:scale-clamp" in planned.plugins) == clamps
        assert bool(planned.optimizer_hooks) == clamps
    assert {row.setting for row in setup.decide(Length(500, 500))} >= {"rules.scale-clamp"}


class Halves(Rule):
    """Halves the opacities of views, and all rates."""

    @hookimpl
    def crossgrad_view_gaussians(self, context):
        gaussians = context.gaussians
        return GaussiansResult(replace(gaussians, opacities=gaussians.opacities * 0.5))

    @hookimpl
    def crossgrad_rate_factor(self, rate):
        return 0.5


class HalvesAgain(Halves):
    """A second rule of that kind."""


def test_each_rule_receives_the_result_of_the_previous_rule():
    found = []
    for rules in ((), (Halves(),), (Halves(), HalvesAgain())):
        setup = setup_of(rules=dict.fromkeys(OURS, False)).with_rules(
            {f"own{row}": rule for row, rule in enumerate(rules)}
        )
        rendered, _ = render_views(setup, first_state(setup), ViewSample((0,)), (1.0,))
        found.append((rendered.records[0].gaussians.opacities, rates_at(setup, 1)))
    (plain, rates), *others = found
    for factor, (opacities, each) in zip((0.5, 0.25), others, strict=True):
        assert torch.equal(opacities, plain * factor)
        assert each == {name: rate * factor for name, rate in rates.items()}


class Answers(Rule):
    """Answers one hook with something that no run can use."""


def answering(hook, answer):
    """A rule that gives this answer to a hook."""

    def implementation(self):
        return answer

    return type("Answering", (Answers,), {hook: hookimpl(implementation)})()


def used(setup, state):
    """Everything that asks hooks of rules."""
    take_step(setup, state)
    eval_parameters(setup, state)
    list(final_edits(setup, state))


def removing(rows):
    return Edit(source=torch.arange(rows))


@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    ("hook", "answer"),
    [
        ("crossgrad_update_intervals", {"gone": 2}),
        ("crossgrad_update_intervals", {"means": 0}),
        ("crossgrad_view_gaussians", GaussiansResult(None)),
        ("crossgrad_view_gaussians", Answer()),
        ("crossgrad_rate_factor", -1.0),
        ("crossgrad_rate_factor", float("nan")),
        ("crossgrad_rate_factor", "half"),
        ("crossgrad_after_optimizer", DensifyResult(removing(3))),
        ("crossgrad_after_optimizer", DensifyResult(None)),
        ("crossgrad_step_done", {"own0": PluginState()}),
        ("crossgrad_eval_parameters", {"gone": torch.zeros(1)}),
        ("crossgrad_final_edit", DensifyResult(removing(3))),
    ],
)
def test_an_unusable_result_of_a_rule_is_refused_with_the_hook(hook, answer):
    setup = setup_of(answering(hook, answer))
    state = first_state(setup)
    with pytest.raises(UserError, match=hook) as caught:
        used(setup, state)
    assert caught.value.todo


def test_a_final_edit_that_does_not_fit_does_not_change_the_state():
    values = Edit(values={"gone": Rows(torch.zeros(1))})
    setup = setup_of(answering("crossgrad_final_edit", FinalEdit(values, "gone")))
    state = first_state(setup)
    tensors = dict(state.tensors)
    with pytest.raises(UserError, match="does not match the Gaussians"):
        list(final_edits(setup, state))
    assert all(state.tensors[name] is tensor for name, tensor in tensors.items())


def test_a_resumed_run_with_all_bundled_rules_has_the_same_bits():
    setup = setup_of(rules=dict.fromkeys(OURS, True), densifier={"name": "adc"})
    assert sorted(setup.selection.rules) == OURS
    whole = first_state(setup)
    for _ in range(6):
        take_step(setup, whole)
    part = from_checkpoint(setup, deepcopy(to_checkpoint(whole)))
    for state in (whole, part):
        for _ in range(6):
            take_step(setup, state)
    assert whole.states["weight-averaging"].values == {"count": 3}
    one, two = (eval_parameters(setup, state) for state in (whole, part))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_rule_that_is_both_added_and_removed_is_refused():
    with pytest.raises(UserError, match="added and removed") as caught:
        merged(None, {"rule": ["dropout"], "no_rule": ["floaters", "dropout"]}, ())
    assert caught.value.found == "dropout"
