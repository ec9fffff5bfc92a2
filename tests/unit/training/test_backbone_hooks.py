"""Requests of backbones and densifiers to the loop: frozen blocks, times, initial values."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import NO_EDIT, Block, Edit, LearningRate, PluginState
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.errors import IncompatibleSelectionError
from crossgrad_core.registry.entries import build, load
from crossgrad_core.run import assemble as assembling
from crossgrad_core.run import decisions as deciding
from crossgrad_core.run import select as selecting
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state


class Numbered(Vanilla):
    """Vanilla with a frozen integer for each primitive and a frozen number for all."""

    def blocks(self):
        frozen = LearningRate(0.0)
        return (
            *super().blocks(),
            Block("number", ("number",), True, "neutral", frozen),
            Block("unit", ("unit",), False, "neutral", frozen),
        )

    def create(self, scene, rng):
        parameters = super().create(scene, rng)
        count = len(parameters["means"])
        return {**parameters, "number": torch.arange(count), "unit": torch.tensor(2.5)}


class Reversing(Densifier):
    """Turns the primitives around once, at the first time it is asked to."""

    def window(self, schedule):
        return replace(schedule, densify_from=1, densify_until=4, densify_every=2)

    def started(self, parameters):
        return {**parameters, "opacities": parameters["opacities"].detach() + 1.0}

    def densify(self, context, state):
        if not context.schedule.densifies(context.step):
            return NO_EDIT, PluginState()
        count = len(context.parameters["means"])
        return Edit(source=torch.arange(count - 1, -1, -1)), PluginState()


class Plain(type(build("rasterizers", "torch", {}))):
    responses: ClassVar[frozenset[str]] = frozenset({"plain"})


class Analytic(Vanilla):
    response: ClassVar[str] = "analytic"


@pytest.fixture
def assembled(monkeypatch):
    own = {"numbered": Numbered, "reversing": Reversing, "plain": Plain, "an": Analytic}
    built = selecting.build

    def build_own(slot, name, options):
        return own[name](**options) if name in own else built(slot, name, options)

    def make(**settings):
        chosen = {name: ComponentChoice(name=value) for name, value in settings.items()}
        config = RunConfig(steps=10, plan="off", **chosen)
        return assembling.assemble(config, sample_scene(), "none")

    monkeypatch.setattr(selecting, "build", build_own)
    for module in (deciding, selecting):
        monkeypatch.setattr(module, "load", lambda slot, name: own.get(name) or load(slot, name))
    return make


def test_frozen_blocks_follow_edits_and_checkpoints_and_are_not_trained(assembled):
    setup = assembled(backbone="numbered", densifier="reversing", operator="pcgrad")
    state = first_state(setup)
    count = len(state.parameters["means"])
    for _ in range(3):
        timed_step(setup, state)
    assert state.parameters["number"].tolist() == list(range(count - 1, -1, -1))
    assert float(state.parameters["unit"]) == 2.5
    assert not {"number", "unit"} & set(state.adam.exp_avg)
    assert {"number", "unit"}.isdisjoint(block.name for block in setup.trained_blocks)
    again = from_checkpoint(setup, to_checkpoint(state)).parameters
    assert torch.equal(again["number"], state.parameters["number"])
    assert again["means"].requires_grad and not again["number"].requires_grad


def test_a_learning_rate_of_zero_freezes_a_block_of_vanilla():
    choice = ComponentChoice.model_validate({"name": "vanilla", "lr_quats": 0.0})
    config = RunConfig(steps=10, backbone=choice)
    setup = assembling.assemble(config, sample_scene(), "none")
    state = first_state(setup)
    before = {name: tensor.detach().clone() for name, tensor in state.parameters.items()}
    timed_step(setup, state)
    assert torch.equal(state.parameters["quats"], before["quats"])
    assert not torch.equal(state.parameters["means"], before["means"])


def test_the_densifier_determines_its_edit_steps_and_the_initial_opacities(assembled):
    setup = assembled(densifier="reversing")
    assert setup.schedule.edits() == 1
    start = first_state(setup).parameters["opacities"]
    plain = first_state(assembled(densifier="none")).parameters["opacities"]
    assert torch.allclose(start, plain + 1.0)
    assert start.requires_grad


@pytest.mark.usefixtures("assembled")
def test_settings_of_the_user_override_the_densifier():
    config = RunConfig(steps=10, densify_every=3, densifier=ComponentChoice(name="reversing"))
    schedule = assembling.assemble(config, sample_scene(), "none").schedule
    assert (schedule.densify_from, schedule.densify_every) == (1, 3)


def test_a_rasterizer_without_the_pixel_response_is_refused(assembled):
    assembled(backbone="an", rasterizer="torch")
    with pytest.raises(IncompatibleSelectionError) as caught:
        assembled(backbone="an", rasterizer="plain")
    assert "does not support the pixel response analytic" in caught.value.found
