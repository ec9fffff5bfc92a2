"""Operators that leave a single gradient as it is say so, and a run with K = 1 notes it."""

import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.aggregation import aggregated, sample_gradients
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

OURS = sorted(n for n, e in entries("operators").items() if e.value.startswith("crossgrad_"))
ADMITTING_ONE = [name for name in OURS if build("operators", name, {}).views.admits(1)]
#: Options under which an operator could do something to one view.
OPTIONS = {
    "cagrad": {"c": 0.9, "rescale": "1+c^2"},
    "chain": {"links": ["symmetric", "pcgrad"]},
    "confgate": {"warmup": 0, "tau": 0.01},
    "dispatch": {"variant": "geometry-projection"},
    "soft": {"threshold": 0.5, "strength": 0.5},
}


def leaves_one_view_alone(operator):
    """Whether the answer to a single view's gradient is that gradient."""
    (gradients,) = sample_gradients(1)
    given = {name: gradient.clone() for name, gradient in gradients.items()}
    found = aggregated(operator, [gradients]).gradients
    return all(torch.allclose(found[name], given[name], rtol=1e-6, atol=0) for name in given)


@pytest.mark.parametrize("name", ADMITTING_ONE)
@pytest.mark.parametrize("options", [{}, OPTIONS], ids=["defaults", "options"])
def test_an_operator_reports_whether_it_keeps_a_single_view_unchanged(name, options):
    operator = build("operators", name, options.get(name, {}))
    if name == "torchjd":  # Which weighting it has is TorchJD's matter: it claims nothing.
        assert not operator.is_identity(1)
        return
    assert operator.is_identity(1) == leaves_one_view_alone(operator)
    assert not operator.is_identity(2)


def test_a_chain_with_an_effective_link_is_not_an_identity():
    links = ["preconditioner", "symmetric"]
    assert not build("operators", "chain", {"links": links}).is_identity(1)


def notes_of(operator, sampler=None, views=None):
    config = RunConfig(
        data={"init": "random"}, steps=10, rasterizer=ComponentChoice(name="torch"),
        operator=ComponentChoice.model_validate(operator), views=views,
        sampler=ComponentChoice.model_validate(sampler or {"name": "epoch"}),
    )  # fmt: skip
    notes = assemble(config, sample_scene(), "none").notes
    return [note for note in notes if "has no effect" in note]


def views_of(operator, sampler=None):
    links = tuple({"name": name} for name in operator.split("+"))
    operators = {"operator": links if len(links) > 1 else links[0]}
    config = RunConfig.model_validate({"sampler": sampler or {"name": "epoch"}, **operators})
    setup = assemble(config, sample_scene(), "none")
    rows = [row for row in setup.decisions if row.setting == "views_per_step" and row.override]
    return setup.selection.views_per_step, [row.because for row in rows]


@pytest.mark.parametrize(
    ("operator", "sampler", "views"),
    [
        ("sum", None, 1),
        ("preconditioner", None, 1),
        ("sum", {"name": "near-far"}, 2),
        ("pcgrad", {"name": "near-far", "alternating": True}, 1),
    ],
)
def test_the_sampler_sets_the_number_of_views_if_the_operator_accepts_it(operator, sampler, views):
    assert views_of(operator, sampler) == (views, [])


@pytest.mark.parametrize("operator", ["pcgrad", "mean", "preconditioner+symmetric", "anchors"])
def test_a_named_operator_gets_enough_views_per_step(operator):
    views, (note,) = views_of(operator)
    assert views == 2
    needed = "the operator needs" if operator == "anchors" else "with fewer views the operator"
    assert note.startswith(needed)


def test_an_operator_without_a_second_view_is_noted_once_with_a_remedy():
    (note,) = notes_of({"name": "pcgrad"}, views=1)
    assert "operator pcgrad has no effect at K = 1" in note
    assert "--views 2" in note


@pytest.mark.parametrize(
    ("operator", "sampler", "views"),
    [
        ({"name": "sum"}, None, None),
        ({"name": "pcgrad"}, None, 2),
        ({"name": "pcgrad"}, {"name": "random"}, None),
        ({"name": "preconditioner"}, None, None),
    ],
    ids=["sum", "two views", "two by default", "weighs one view"],
)
def test_an_operator_with_an_effect_gets_no_note(operator, sampler, views):
    assert notes_of(operator, sampler, views) == []


def test_the_note_names_a_sampler_that_draws_one_view_only():
    (note,) = notes_of({"name": "pcgrad"}, {"name": "near-far", "alternating": True})
    assert "--views" not in note and "near-far" in note


def test_a_run_with_the_note_equals_a_plain_run():
    def trained(operator):
        config = RunConfig(
            data={"init": "random"}, steps=10, rasterizer=ComponentChoice(name="torch"),
            sampler=ComponentChoice(name="epoch"), operator=ComponentChoice(name=operator), views=1,
        )  # fmt: skip
        state = first_state(setup := assemble(config, sample_scene(), "none"))
        timed_step(setup, state)
        return state.parameters

    plain, noted = trained("sum"), trained("pcgrad")
    assert all(torch.equal(plain[name], noted[name]) for name in plain)
