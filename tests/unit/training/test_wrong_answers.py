"""Answers of plugins that are no answers: one message that names the plugin, or its hook."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import (
    NO_EDIT,
    TAKEN,
    Block,
    Edit,
    LearningRate,
    PluginState,
    Rows,
)
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import DensifyResult, RegularizeResult, ViewSample
from crossgrad_core.contract.gramian_operator import GramianOperator, Weighting, _kinds
from crossgrad_core.contract.objections import objections_to
from crossgrad_core.contract.slots import densifier, operator, resolution, sampler
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.exposure import Exposure
from crossgrad_core.contract.slots.initializer import MorePoints
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run import select as selecting
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import growth_budget, per_image_params, start, step
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import apply_edit, take_step


def setup_of(replaced=None, **observers):
    """A run on the sample scene with components by slot, and plugins, in the place of others."""
    config = RunConfig.model_validate({"steps": 10, "initializer": {"name": "points"}})
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


@pytest.mark.sampled(7)
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
def test_a_result_without_its_state_is_reported_with_the_method(word, slot, name, method, answer):
    error = refused(setup_of({word: of_slot(slot, name, method, answer)}))
    assert f"Wrong.{method} returned a value of a wrong type" in error.what
    assert __name__ in error.where
    assert error.expected.startswith("a pair: ")


@pytest.mark.parametrize("answer", [None, (1, 2)])
def test_the_method_decode_must_return_gaussians(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "decode", answer)}))
    assert "Wrong.decode returned a value of a wrong type" in error.what
    assert error.expected == "Gaussians"


@pytest.mark.parametrize("answer", [None, 3, (1, 2)])
def test_backbones_must_create_tensors(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "create", answer)}))
    assert "Wrong.create returned a value of a wrong type" in error.what


@pytest.mark.parametrize("answer", [{}, {"moans": torch.zeros(3, 3)}, {"means": None}])
def test_backbones_must_create_exactly_the_tensors_of_their_blocks(answer):
    error = refused(setup_of({"backbone": of_slot("backbones", "vanilla", "create", answer)}))
    assert "Wrong.create returned tensors with other names than its blocks use" in error.what
    assert error.expected == "means"
    assert error.found == (", ".join(n for n, t in answer.items() if t is not None) or "none")


def test_the_method_prepare_must_return_all_tensors_of_the_blocks():
    backbone = of_slot("backbones", "vanilla", "prepare", {"means": torch.zeros(3, 3)})
    error = refused(setup_of({"backbone": backbone}))
    assert "Wrong.prepare returned tensors with other names" in error.what
    assert error.expected.startswith("means, scales, quats")


def test_tensors_that_a_backbone_prepares_need_not_be_created():
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
def test_the_method_more_points_must_return_points(answer):
    error = refused(
        setup_of({"initializer": of_slot("initializers", "points", "more_points", answer)})
    )
    assert "Wrong.more_points returned a value of a wrong type" in error.what
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
def test_the_method_fitted_to_must_return_a_component_of_its_slot(
    monkeypatch, base, slot, name, answer
):
    original, wrong = selecting.chosen, of_slot(slot, name, "fitted_to", answer)

    def built(kind, choice):
        return wrong if kind is base else original(kind, choice)

    monkeypatch.setattr(selecting, "chosen", built)
    with pytest.raises(UserError, match=r"Wrong\.fitted_to returned a value of a wrong type"):
        assemble(RunConfig(steps=10), sample_scene(), "none")


@pytest.mark.parametrize("scales", ["a", (None,), ()])
def test_render_scales_must_be_numbers(scales):
    wrong = of_slot("resolutions", "full", "scales", (scales, PluginState()))
    assert refused(setup_of({"resolution": wrong})).what.startswith(
        "the resolution returned a wrong scale"
    )


@pytest.mark.parametrize("shape", [(2,), (6, 3), (5, 2), ()])
def test_weights_of_a_wrong_shape_are_reported_with_both_shapes(shape):
    class Own(Weighting):
        def weights(self, gramians, context):
            return np.ones(shape)

    setup = setup_of({"operator": Own()})
    assert len(setup.trained_blocks) == 6
    error = refused(setup)
    assert error.what == "operator Own returned an array of a wrong shape"
    assert error.expected.startswith("[6, 1] weights")
    assert error.found == str(list(shape))


@pytest.mark.parametrize("tail", [(3,), (1, 2)])
def test_matrices_of_a_wrong_shape_are_reported_with_their_shape(tail):
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
        Answers(after=DensifyResult(None)),
        Answers(term=torch.ones(())),
        Answers(term=1.0),
        Answers(term=RegularizeResult(1.0)),
        Answers(term=RegularizeResult(torch.ones(3))),
    ],
)
def test_a_wrong_hook_result_names_the_plugin(plugin):
    error = refused(setup_of(stranger=plugin))
    assert "for the hook crossgrad_" in error.what
    assert "stranger" in error.where


def test_correct_results_are_accepted():
    plugin = Answers(DensifyResult(NO_EDIT), RegularizeResult(torch.ones(1)))
    setup = setup_of(stranger=plugin)
    assert take_step(setup, first_state(setup)).step == 1


@pytest.mark.parametrize("name", sorted(TAKEN))
def test_plugin_states_under_names_of_other_plugins_are_refused(name):
    plugin = Answers(DensifyResult(NO_EDIT, states={name: PluginState({"n": 1})}))
    error = refused(setup_of(stranger=plugin))
    assert repr(name) in error.what
    assert error.where == "crossgrad_after_step, one of stranger"


@pytest.mark.parametrize("states", [None, [PluginState()]])
def test_states_must_be_a_mapping(states):
    plugin = Answers(DensifyResult(NO_EDIT, states=states))
    assert refused(setup_of(stranger=plugin)).expected.startswith("a mapping")


def test_a_component_stores_its_state_in_every_hook_that_it_implements():
    kind = type(build("densifiers", "none", {}))

    class Own(kind):
        @hookimpl
        def crossgrad_after_step(self, context):
            return DensifyResult(NO_EDIT, states={"densifier": PluginState({"n": context.step})})

    setup = setup_of({"densifier": Own()})
    state = first_state(setup)
    take_step(setup, state)
    assert state.states["densifier"].values == {"n": 1}


def test_a_state_of_a_wrong_type_is_refused_at_once():
    plugin = Answers(DensifyResult(NO_EDIT, states={"stranger": {"n": 1}}))
    assert refused(setup_of(stranger=plugin)).found == "dict"


def test_the_reserved_names_are_the_state_names_of_the_core():
    slots = {each.STATE for each in (sampler, operator, densifier, resolution)}
    own = {each.STATE for each in (per_image_params, growth_budget)} | {step.GROUPING}
    assert slots | own | {start.THINNED} == TAKEN


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    ("edit", "found"),
    [
        (Edit(source=torch.arange(41)), "source contains indices outside 0 to 39"),
        (Edit(source=torch.tensor([-1])), "source contains indices outside 0 to 39"),
        (Edit(source=torch.arange(40).int()), "not [M] of torch.int64"),
        (Edit(source=torch.tensor(3)), "[] of torch.int64, not [M]"),
        (Edit(source=[0, 1]), "builtins.list, not a tensor"),
        (Edit(source=np.arange(40)), "numpy.ndarray, not a tensor"),
        (Edit(source=torch.arange(3), fresh=torch.ones(3)), "fresh is [3] of torch.float32"),
        (Edit(values={"means": torch.zeros(40, 3)}), "Tensor, not Rows"),
        (Edit(values={"means": Rows(np.zeros((40, 3)))}), "not Rows of a tensor"),
        (
            Edit(values={"means": Rows(torch.zeros(1, 3), torch.tensor([40]))}),
            "rows contain indices outside 0 to 39",
        ),
        (
            Edit(values={"means": Rows(torch.zeros(1, 3), torch.tensor([-1]))}),
            "rows contain indices outside 0 to 39",
        ),
        (Edit(values={"means": Rows(torch.zeros(3), torch.ones(40).bool())}), "rows are [40] of"),
        (
            Edit(source=torch.arange(3), fresh=torch.ones(4).bool()),
            "fresh has 4 rows, but there are 3",
        ),
        (Edit(values={"mean": Rows(torch.zeros(40, 3))}), "no tensor 'mean'"),
        (Edit(values={"means": Rows(torch.zeros(40, 2))}), "[40, 2], not [40, 3]"),
        (Edit(values={"means": Rows(torch.zeros(39, 3))}), "[39, 3], not [40, 3]"),
        (
            Edit(values={"means": Rows(torch.zeros(3, 3), torch.arange(2))}),
            "[3, 3], not [2, 3]",
        ),
    ],
)
def test_an_edit_that_does_not_fit_is_reported_with_the_reason(edit, found):
    setup = setup_of(stranger=Answers(DensifyResult(edit)))
    state = first_state(setup)
    assert state.primitives(setup) == 40
    with pytest.raises(UserError, match="does not match the Gaussians") as caught:
        take_step(setup, state)
    assert found in caught.value.found


@pytest.mark.parametrize("values", [torch.zeros(()), torch.zeros(3), torch.zeros(1, 3)])
def test_values_that_broadcast_over_the_rows_are_accepted(values):
    setup = setup_of(stranger=Answers(DensifyResult(Edit(values={"means": Rows(values)}))))
    state = first_state(setup)
    take_step(setup, state)
    assert not state.parameters["means"].detach().any()


class Wraps:
    """A plugin that replaces the aggregated gradients by what a function makes of them."""

    def __init__(self, change):
        self.change = change

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        answer = yield
        return self.change(answer)


def with_means(means):
    return Wraps(lambda answer: replace(answer, gradients={**answer.gradients, "means": means}))


@pytest.mark.parametrize(
    ("plugin", "found"),
    [
        (Wraps(lambda answer: replace(answer, gradients=None)), "NoneType, not a mapping"),
        (Wraps(lambda answer: replace(answer, counts=None)), "NoneType, not a mapping"),
        (Wraps(lambda answer: replace(answer, gradients={})), "means is missing"),
        (
            Wraps(lambda answer: replace(answer, gradients={**answer.gradients, "mean": None})),
            "mean is unknown",
        ),
        (with_means(np.zeros((40, 3), np.float32)), "means: ndarray"),
        (with_means(torch.zeros(40, 2)), "means: [40, 2] of torch.float32, not [40, 3]"),
        (with_means(torch.zeros(40, 3).double()), "[40, 3] of torch.float64, not [40, 3]"),
    ],
)
def test_aggregated_gradients_must_fit_the_parameters(plugin, found):
    error = refused(setup_of(wrapping=plugin))
    assert error.what == "the aggregated gradients do not match the parameters"
    assert "operator sum" in error.where
    assert found in error.found


def test_an_aggregation_may_skip_a_tensor_and_return_numpy_numbers_as_counts():
    counts = {"dropped": np.int64(2), "odd": torch.tensor(3)}
    setup = setup_of(
        wrapping=Wraps(lambda answer: replace(answer, counts=counts)), a=with_means(None)
    )
    state = first_state(setup)
    record = take_step(setup, state)
    numbers = {**record.counts, "": state.counters.dropped}
    assert numbers == {"dropped": 2, "odd": 3, "": 2}
    assert {type(each) for each in numbers.values()} == {int}


def labelled(labels):
    return of_slot("samplers", "random", "sample", (ViewSample((0,), labels), PluginState()))


@pytest.mark.parametrize("labels", [(), ("a", "b"), "a", 3, (3,), (None,), {"a": 1}])
def test_a_sampler_must_return_one_text_label_for_each_view(labels):
    error = refused(setup_of({"sampler": labelled(labels)}))
    assert error.what == "the sampler returned a wrong number of labels"
    assert "sampler epoch" in error.where


@pytest.mark.parametrize("labels", [["a"], np.array(["a"])])
def test_a_sampler_may_return_its_labels_as_a_list(labels):
    setup = setup_of({"sampler": labelled(labels)})
    assert take_step(setup, first_state(setup)).labels == ("a",)


def test_render_scales_given_as_numpy_numbers_become_python_numbers_in_the_record():
    wrong = of_slot("resolutions", "full", "scales", ((np.float32(0.5),), PluginState()))
    setup = setup_of({"resolution": wrong})
    scales = take_step(setup, first_state(setup)).scales
    assert scales == (0.5,) and type(scales[0]) is float


@pytest.mark.parametrize(
    ("held", "found"),
    [
        (PluginState({"range": (0.0, 1.0)}), "values, range: (0.0, 1.0) of type tuple"),
        (PluginState({"a": [{"b": {1: 2}}]}), "values, a: the key 1"),
        (PluginState({"n": np.int64(3)}), "values, n: "),
        (PluginState({1: 2}), "values, 1: the key is not a string"),
        (PluginState(tensors={"t": np.zeros(3)}), "tensors, t: of type ndarray"),
        (PluginState(tensors={"t": torch.eye(3).to_sparse()}), "tensors, t: torch.sparse_coo"),
        (PluginState(tensors={"t": torch.zeros(3, device="meta")}), "meta"),
        (PluginState(per_primitive={"t": torch.zeros(40).cdouble()}), "per_primitive, t: "),
    ],
)
def test_a_state_that_a_checkpoint_cannot_store_is_refused_at_once(held, found):
    error = refused(setup_of(stranger=Answers(DensifyResult(NO_EDIT, states={"stranger": held}))))
    assert error.what == "a checkpoint cannot hold the state of plugin stranger"
    assert found in error.where


def test_a_state_with_new_names_is_checked_again():
    plugin = Answers(DensifyResult(NO_EDIT, states={"stranger": PluginState()}))
    setup = setup_of(stranger=plugin)
    state = first_state(setup)
    take_step(setup, state)
    plugin.after = DensifyResult(NO_EDIT, states={"stranger": PluginState({"seen": {1}})})
    with pytest.raises(UserError, match="a checkpoint cannot hold"):
        take_step(setup, state)


def test_an_edit_of_fresh_rows_resets_their_moments_and_statistics():
    fresh = torch.arange(40) < 3
    held = PluginState(per_primitive={"seen": torch.ones(40)})
    plugin = Answers(DensifyResult(NO_EDIT, states={"stranger": held}))
    setup = setup_of(stranger=plugin)
    state = first_state(setup)
    take_step(setup, state)
    before = {name: tensor.detach().clone() for name, tensor in state.parameters.items()}
    assert apply_edit(setup, state, Edit(fresh=fresh)) is False
    for moments in (state.adam.exp_avg, state.adam.exp_avg_sq):
        assert not moments["scales"][:3].any() and moments["scales"][3:].any()
    assert torch.equal(state.states["stranger"].per_primitive["seen"], (~fresh).float())
    assert all(torch.equal(before[name], t) for name, t in state.parameters.items())


@pytest.mark.parametrize("rows", [torch.tensor(3.0), torch.zeros(39)])
def test_a_state_without_a_row_for_each_primitive_names_its_plugin(rows):
    held = PluginState(per_primitive={"seen": rows})
    edit = Edit(source=torch.arange(40))
    plugin = Answers(DensifyResult(edit, states={"stranger": held}))
    error = refused(setup_of(stranger=plugin))
    assert error.what == "the state of plugin stranger does not match the Gaussians"
    assert error.found == f"shape {list(rows.shape)}"


def more_points(**changed):
    good = {
        "positions": np.zeros((2, 3)),
        "colors": np.zeros((2, 3), np.uint8),
        "sizes": np.ones(2),
        "opacities": np.full(2, 0.5),
    }
    return MorePoints(**{**good, **changed})


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"sizes": np.ones(1)}, "2 positions, 1 sizes"),
        ({"colors": np.zeros((3, 3), np.uint8)}, "2 positions, 3 colors"),
        ({"positions": np.zeros((2, 2))}, "ValueError"),
        ({"positions": np.full((2, 3), np.nan)}, "position that is not finite"),
        ({"sizes": np.array([1.0, 0.0])}, "a size that is not a number above 0"),
        ({"sizes": np.array([1.0, np.inf])}, "a size that is not a number above 0"),
        ({"opacities": np.array([0.5, 1.0])}, "an opacity that is not between 0 and 1"),
    ],
)
def test_points_added_by_an_initializer_must_be_valid(changed, found):
    start = of_slot("initializers", "points", "more_points", more_points(**changed))
    error = refused(setup_of({"initializer": start}))
    assert error.what == "initializer points returned invalid points"
    assert "Wrong.more_points" in error.where
    assert found in error.found


def test_valid_points_of_an_initializer_are_used_and_its_errors_are_passed_on():
    setup = setup_of(
        {"initializer": of_slot("initializers", "points", "more_points", more_points())}
    )
    assert first_state(setup).primitives(setup) == 42

    class Failing(type(build("initializers", "points", {}))):
        def more_points(self, scene):
            raise ValueError("no luck")

    with pytest.raises(ValueError, match="no luck"):
        first_state(setup_of({"initializer": Failing()}))


@pytest.mark.parametrize("form", ["d", "%.2f"])
def test_an_invalid_number_format_of_a_metric_is_refused_before_the_run(monkeypatch, form):
    psnr = type(build("metrics", "psnr", {}))
    monkeypatch.setattr(psnr, "figure", replace(psnr.figure, form=form))
    with pytest.raises(UserError, match="a value of metric psnr cannot be formatted") as caught:
        assemble(RunConfig(steps=10), sample_scene(), "none")
    assert caught.value.found == repr(form)


def test_group_labels_that_are_numbers_are_listed_in_the_objection():
    setup = setup_of({"sampler": build("samplers", "near-far", {})})
    names = {**setup.selection.names, "grouping": "odd"}
    selection = replace(setup.selection, names=names, labels=(0, 1, 2))
    assert "makes 3: 0, 1, 2" in " ".join(objections_to(selection))


def test_groups_of_blocks_are_named_by_their_kinds_for_any_block_names():
    rate = LearningRate(1.0)
    blocks = (
        Block("all", ("a",), True, "geometry", rate),
        Block("geometry", ("b",), True, "appearance", rate),
        Block("appearance", ("c",), False, "neutral", rate),
    )
    names = ("geometry", "appearance")
    assert _kinds(names, blocks, "kind") == names
    assert _kinds(("all",), blocks, "global") == ("neutral",)
    for granularity in ("block", "gaussian"):
        assert _kinds(names, blocks, granularity) == ("appearance", "neutral")
