"""Observers that go wrong late, or cost too much, are refused for that reason."""

from dataclasses import replace
from time import sleep

import pytest
import torch
from pydantic import PrivateAttr

from crossgrad_core import plugin as api
from crossgrad_core.testing import observers
from crossgrad_core.testing.support.contract import ContractError

pytestmark = pytest.mark.usefixtures("few_objects")


class RaisesLate(api.Observer):
    @api.hookimpl
    def crossgrad_step_end(self, record):
        if record.step == 13:
            raise ValueError("a bad day")


class EndsTheProgram(api.Observer):
    @api.hookimpl
    def crossgrad_step_end(self, record):
        if record.step == 3:
            raise SystemExit(0)


class ShiftsLate(api.Observer):
    @api.hookimpl
    def crossgrad_model_ready(self, model):
        if model.phase.step >= 100:
            model.parameters["means"].data.add_(1.0)


class NotANumberLate(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        answer = yield
        if context.step < 9:
            return answer
        return replace(answer, gradients={n: g * torch.nan for n, g in answer.gradients.items()})


class NotANumberInAnEdit(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        answer = yield
        means = torch.full_like(context.parameters["means"].detach(), torch.nan)
        return replace(answer, edit=api.Edit(values={"means": api.Rows(means)}))


class NoLossLate(api.Observer):
    @api.hookimpl
    def crossgrad_regularize(self, context):
        term = context.parameters["means"].mean()
        return api.RegularizeResult(term * torch.nan if context.step > 10 else term)


class RemembersAll(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        answer = yield
        seen = [*context.state("all").values.get("seen", []), context.step]
        return answer.with_state("all", api.PluginState({"seen": seen}))


class KeepsBytes(api.Observer):
    _kept: list[bytes] = PrivateAttr(default_factory=list)

    @api.hookimpl
    def crossgrad_step_end(self, record):
        self._kept.append(bytes(300_000))


class KeepsTensors(api.Observer):
    _kept: list[torch.Tensor] = PrivateAttr(default_factory=list)

    @api.hookimpl
    def crossgrad_model_ready(self, model):
        self._kept.append(torch.zeros(100_000))


class KeepsOnce(api.Observer):
    """A buffer of one size is no leak."""

    _kept: list[bytes] = PrivateAttr(default_factory=list)

    @api.hookimpl
    def crossgrad_step_end(self, record):
        self._kept[:] = [bytes(3_000_000)]


class Sleeps(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        sleep(0.15)


@pytest.mark.parametrize(
    ("check", "make", "words"),
    [
        (observers.survives_every_event, RaisesLate, "step 13: .* ValueError: a bad day"),
        (observers.survives_every_event, EndsTheProgram, "step 3: .* SystemExit"),
        (observers.the_model_stays_untouched, ShiftsLate, "step 100: .* parameters means"),
        (observers.hooks_stay_answered, NotANumberLate, "step 9: .* not finite"),
        (observers.hooks_stay_answered, NotANumberInAnEdit, "means is not finite"),
        (observers.questions_are_answered_in_kind, NoLossLate, "not a finite scalar"),
        (observers.states_stay_bounded, RemembersAll, "grows without limit"),
        (observers.nothing_piles_up, KeepsBytes, "0.3 MB more memory after each step"),
        (observers.nothing_piles_up, KeepsTensors, "0.4 MB more memory after each step"),
        (observers.steps_are_not_held_up, Sleeps, "crossgrad_after_step takes 0.1"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_wrong_observer_is_refused_with_the_right_reason(check, make, words, short_windows):
    with pytest.raises(ContractError, match=words):
        check(make)


@pytest.mark.slow
def test_an_observer_may_keep_a_buffer_of_constant_size():
    observers.nothing_piles_up(KeepsOnce)
