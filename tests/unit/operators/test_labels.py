"""Operators that need labelled views refuse selections that give none."""

import pytest
from support.selections import selection_of

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.objections import objections_to_views
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene

LABELLED = "operator {} needs labelled views, but sampler random draws without groups"


def objections(name, sampler, grouping=None, views=2):
    operator = build("operators", name, {})
    selection = selection_of(
        operator=operator,
        sampler=build("samplers", sampler, {}),
        grouping=None if grouping is None else build("groupings", grouping, {}),
        names={"operator": name, "sampler": sampler, "grouping": grouping},
        views_per_step=views,
    )
    own = getattr(operator, "crossgrad_validate_selection", lambda _: [])
    return objections_to_views(operator, selection) + own(selection)


@pytest.mark.parametrize("name", ["anchors", "gradnorm"])
def test_a_sampler_without_groups_is_refused(name):
    assert objections(name, "random") == [LABELLED.format(name)]
    assert objections(name, "near-far", "radial") == []
    assert objections(name, "random", "lists") == []


def test_anchors_need_near_and_far_views():
    (reason,) = objections("anchors", "random-split")
    assert "near (operator.near) and far (operator.far)" in reason
    assert objections("gradnorm", "random-split") == []


def test_the_anchors_operator_requires_two_views():
    assert objections("anchors", "anchors-30", "anchors", views=4) == [
        "operator anchors needs K = 2 (--views); K is 4"
    ]


@pytest.mark.parametrize("name", ["sum", "symmetric", "upgrad", "graddrop", "chain"])
@pytest.mark.parametrize("views", [1, 2, 5])
def test_operators_other_than_anchors_accept_any_views(name, views):
    assert objections(name, "random", views=views) == []


CHAIN = {"name": "chain", "links": ["gradnorm"]}


@pytest.mark.parametrize("operator", [{"name": "anchors"}, {"name": "gradnorm"}, CHAIN], ids=str)
@pytest.mark.parametrize("sampler", ["epoch", "random", "fps"])
def test_an_operator_selects_the_grouping_that_it_needs(operator, sampler):
    config = RunConfig.model_validate(
        {"steps": 10, "operator": operator, "sampler": {"name": sampler}}
    )
    setup = assemble(config, sample_scene(), "none")
    assert {"near", "far"} <= set(setup.groups)
    assert setup.operator.views.admits(setup.selection.views_per_step)
