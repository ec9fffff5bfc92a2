"""Answers of plugins that are no answers: one message that names the plugin, or its hook."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract import densifier, operator, resolution, sampler
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.contexts import Densified, Regularized
from crossgrad_core.contract.exposure import Exposure
from crossgrad_core.contract.gramian_operator import GramianOperator, Weighting
from crossgrad_core.contract.marks import hookimpl
from crossgrad_core.contract.state import TAKEN, PluginState
from crossgrad_core.contract.topology import NO_EDIT, Edit, Rows
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run import select as selecting
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import photo_parameters, regrouping, room, start, steady
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import take_step


def setup_of(replaced=None, **observers):
    """A run on the sample scene with components by slot, and plugins, in the place of others."""
    config = RunConfig.model_validate({"steps": 10, "start": {"name": "sfm"}})
    setup = assemble(config, sample_scene(), "none")
    selection = replace(setup.selection, **(replaced or {}))
    plugins = {**setup.plugins, **selection.components, **observers}
    return replace(setup, selection=selection, manager=make_manager(plugins), plugins=plugins)


def refused(setup):
    with pytest.raises(UserError) as caught:
        take_step(setup, first_state(setup))
    return caught.value


def of_slot(slot, name, method, answer):
    """The component of that name, one method of which answers something else."""
    kind = type(build(slot, name, {}))

    def wrong(self, *_):
        return answer

    return type("Wrong", (kind,), {method: wrong, "__module__": __name__})()


@pytest.mark.parametrize("answer", [None, NO_EDIT, (NO_EDIT,), (None, PluginState())])
@pytest.mark.parametrize(
    ("word", "slot", "name", "method"),
    [
        ("sampler", "samplers", "random", "sample"),
        ("operator", "operators", "sum", "aggregate"),
        ("operator", "operators", "pcgrad", "transform"),
        ("densifier", "densifiers", "none", "densify"),
        ("resolution", "resolutions", "full", "scales"),
    ],
)
def test_an_answer_without_its_state_names_the_method(word, slot, name, method, answer):
    error = refused(setup_of({word: of_slot(slot, name, method, answer)}))
    assert f"Wrong.{method} gave a wrong answer" in error.what
    assert __name__ in error.where
    assert error.expected.startswith("a pair: ")


@pytest.mark.parametrize("answer", [None, (1, 2)])
def test_what_a_backbone_decodes_are_gaussians(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "decode", answer)}))
    assert "Wrong.decode gave a wrong answer" in error.what
    assert error.expected == "Gaussians"


@pytest.mark.parametrize("answer", [None, 3, (1, 2)])
def test_what_a_backbone_creates_are_tensors(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "create", answer)}))
    assert "Wrong.create gave a wrong answer" in error.what


@pytest.mark.parametrize("answer", [{}, {"moans": torch.zeros(3, 3)}, {"means": None}])
def test_what_a_backbone_creates_is_what_its_blocks_name(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "create", answer)}))
    assert "Wrong.create makes other tensors than its blocks name" in error.what
    assert error.expected == "means"
    assert error.found == (", ".join(n for n, t in answer.items() if t is not None) or "none")


def test_what_a_backbone_has_prepared_is_all_that_its_blocks_name():
    backbone = of_slot("backbones", "vanilla", "prepare", {"means": torch.zeros(3, 3)})
    error = refused(setup_of({"backbone": backbone}))
    assert "Wrong.prepare makes other tensors" in error.what
    assert error.expected.startswith("means, scales, quats")


def test_what_a_backbone_prepares_it_need_not_create():
    class Late(type(build("backbones", "vanilla", {}))):
        def create(self, scene, rng):
            made = super().create(scene, rng)
            return {name: tensor for name, tensor in made.items() if name != "f_rest"}

        def prepare(self, parameters, scene, phase):
            rest = torch.zeros(len(parameters["means"]), 15, 3, requires_grad=True)
            return {"f_rest": rest, **parameters}

    setup = setup_of({"backbone": Late()})
    assert "f_rest" in first_state(setup).parameters


@pytest.mark.parametrize("answer", [3, ()])
def test_what_a_start_adds_are_points(answer):
    error = refused(setup_of({"start": of_slot("starts", "sfm", "more_points", answer)}))
    assert "Wrong.more_points gave a wrong answer" in error.what
    assert error.expected == "MorePoints"


@pytest.mark.parametrize(
    ("base", "slot", "name", "answer"),
    [
        (Exposure, "exposures", "none", None),
        *(
            (Backbone, "backbones", "vanilla", each)
            for each in (None, (1, 2), (1, 2, 3), (None, ()))
        ),
    ],
)
def test_what_is_fitted_to_the_scene_is_of_its_kind(monkeypatch, base, slot, name, answer):
    original, wrong = selecting._built, of_slot(slot, name, "fitted_to", answer)

    def built(kind, choice):
        return wrong if kind is base else original(kind, choice)

    monkeypatch.setattr(selecting, "_built", built)
    with pytest.raises(UserError, match=r"Wrong\.fitted_to gave a wrong answer"):
        assemble(RunConfig(steps=10), sample_scene(), "none")


@pytest.mark.parametrize("scales", ["a", (None,), ()])
def test_scales_are_numbers(scales):
    wrong = of_slot("resolutions", "full", "scales", (scales, PluginState()))
    assert refused(setup_of({"resolution": wrong})).what.startswith("the resolution does not give")


@pytest.mark.parametrize("shape", [(2,), (6, 3), (5, 2), ()])
def test_weights_of_another_shape_say_which(shape):
    class Own(Weighting):
        def weights(self, gramians, context):
            return np.ones(shape)

    setup = setup_of({"operator": Own()})
    assert len(setup.trained_blocks) == 6
    error = refused(setup)
    assert error.what == "operator Own gave an array of a wrong shape"
    assert error.expected.startswith("[6, 1] weights")
    assert error.found == str(list(shape))


@pytest.mark.parametrize("tail", [(3,), (1, 2)])
def test_matrices_of_another_shape_say_which(tail):
    class Own(GramianOperator):
        def transform(self, gramians, context, state, rng):
            return np.ones((len(gramians), 1, *tail)), state

    assert refused(setup_of({"operator": Own()})).found == str([6, 1, *tail])


class Answers:
    """A plugin that answers after each step, and with a term of the loss."""

    def __init__(self, after=None, term=None):
        self.after, self.term = after, term

    @hookimpl
    def crossgrad_after_step(self, context):
        return self.after

    @hookimpl
    def crossgrad_regularize(self, context):
        return self.term


@pytest.mark.parametrize(
    "plugin",
    [
        Answers(after=NO_EDIT),
        Answers(after=Densified(None)),
        Answers(term=torch.ones(())),
        Answers(term=1.0),
        Answers(term=Regularized(1.0)),
        Answers(term=Regularized(torch.ones(3))),
    ],
)
def test_a_question_answered_with_something_else_names_the_plugin(plugin):
    error = refused(setup_of(stranger=plugin))
    assert "answers crossgrad_" in error.what
    assert "stranger" in error.where


def test_right_answers_pass():
    plugin = Answers(Densified(NO_EDIT), Regularized(torch.ones(1)))
    setup = setup_of(stranger=plugin)
    assert take_step(setup, first_state(setup)).step == 1


@pytest.mark.parametrize("name", sorted(TAKEN))
def test_names_of_others_are_refused(name):
    plugin = Answers(Densified(NO_EDIT, states={name: PluginState({"n": 1})}))
    error = refused(setup_of(stranger=plugin))
    assert repr(name) in error.what
    assert error.where == "crossgrad_after_step, one of stranger"


@pytest.mark.parametrize("states", [None, [PluginState()]])
def test_states_are_a_mapping(states):
    plugin = Answers(Densified(NO_EDIT, states=states))
    assert refused(setup_of(stranger=plugin)).expected.startswith("a mapping")


def test_a_component_keeps_its_own_state_in_every_hook_that_it_has():
    kind = type(build("densifiers", "none", {}))

    class Own(kind):
        @hookimpl
        def crossgrad_after_step(self, context):
            return Densified(NO_EDIT, states={"densifier": PluginState({"n": context.step})})

    setup = setup_of({"densifier": Own()})
    state = first_state(setup)
    take_step(setup, state)
    assert state.states["densifier"].values == {"n": 1}


def test_a_state_that_is_none_is_refused_at_once():
    plugin = Answers(Densified(NO_EDIT, states={"stranger": {"n": 1}}))
    assert refused(setup_of(stranger=plugin)).found == "dict"


def test_the_names_of_the_core_are_those_that_it_uses():
    slots = {each.STATE for each in (sampler, operator, densifier, resolution)}
    own = {each.STATE for each in (photo_parameters, regrouping, room, steady)}
    assert slots | own | {start.THINNED} == TAKEN


@pytest.mark.parametrize(
    ("edit", "found"),
    [
        (Edit(source=torch.arange(41)), "source leaves 0 to 39"),
        (Edit(source=torch.tensor([-1])), "source leaves 0 to 39"),
        (Edit(source=torch.arange(40).int()), "not [M] of torch.int64"),
        (Edit(source=torch.tensor(3)), "[] of torch.int64, not [M]"),
        (Edit(source=[0, 1]), "builtins.list, not a tensor"),
        (Edit(source=np.arange(40)), "numpy.ndarray, not a tensor"),
        (Edit(source=torch.arange(3), fresh=torch.ones(3)), "fresh is [3] of torch.float32"),
        (Edit(values={"means": torch.zeros(40, 3)}), "Tensor, not Rows"),
        (Edit(values={"means": Rows(np.zeros((40, 3)))}), "not Rows of a tensor"),
        (Edit(values={"means": Rows(torch.zeros(1, 3), torch.tensor([40]))}), "rows leave 0 to 39"),
        (Edit(values={"means": Rows(torch.zeros(1, 3), torch.tensor([-1]))}), "rows leave 0 to 39"),
        (Edit(values={"means": Rows(torch.zeros(3), torch.ones(40).bool())}), "rows are [40] of"),
        (Edit(source=torch.arange(3), fresh=torch.ones(4).bool()), "fresh has 4 rows of 3"),
        (Edit(values={"mean": Rows(torch.zeros(40, 3))}), "no tensor 'mean'"),
        (Edit(values={"means": Rows(torch.zeros(40, 2))}), "[40, 2], not [40, 3]"),
        (Edit(values={"means": Rows(torch.zeros(39, 3))}), "[39, 3], not [40, 3]"),
        (
            Edit(values={"means": Rows(torch.zeros(3, 3), torch.arange(2))}),
            "[3, 3], not [2, 3]",
        ),
    ],
)
def test_an_edit_that_does_not_fit_says_how(edit, found):
    setup = setup_of(stranger=Answers(Densified(edit)))
    state = first_state(setup)
    assert state.primitives(setup) == 40
    with pytest.raises(UserError, match="does not fit the primitives") as caught:
        take_step(setup, state)
    assert found in caught.value.found


@pytest.mark.parametrize("values", [torch.zeros(()), torch.zeros(3), torch.zeros(1, 3)])
def test_values_that_spread_over_the_rows_fit(values):
    setup = setup_of(stranger=Answers(Densified(Edit(values={"means": Rows(values)}))))
    state = first_state(setup)
    take_step(setup, state)
    assert not state.parameters["means"].detach().any()
