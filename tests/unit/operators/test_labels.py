"""Operators that need labelled views refuse selections that give none."""

import pytest

from crossgrad_core.contract.component import Selection
from crossgrad_core.registry.entries import build

LABELLED = "operator {} needs labelled views; sampler random draws from no groups"


def objections(name, sampler, grouping=None, views=2):
    operator = build("operators", name, {})
    components = {"operator": operator, "sampler": build("samplers", sampler, {})}
    names = {"operator": name, "sampler": sampler}
    if grouping is not None:
        components["grouping"] = build("groupings", grouping, {})
        names["grouping"] = grouping
    return operator.crossgrad_objections(Selection(components, names, views, "cpu"))


@pytest.mark.parametrize("name", ["anchors", "gradnorm"])
def test_a_sampler_without_groups_is_refused(name):
    assert objections(name, "random") == [LABELLED.format(name)]
    assert objections(name, "near-far", "radial") == []
    assert objections(name, "random", "lists") == []


def test_anchors_need_near_and_far_views():
    (reason,) = objections("anchors", "random-split")
    assert "near (operator.near) and far (operator.far)" in reason
    assert objections("gradnorm", "random-split") == []


def test_anchors_need_pairs():
    assert objections("anchors", "anchors-30", "anchors", views=4) == [
        "operator anchors needs K = 2; K = 4 was asked for"
    ]


@pytest.mark.parametrize("name", ["sum", "symmetric", "upgrad", "graddrop", "chain"])
@pytest.mark.parametrize("views", [1, 2, 5])
def test_other_operators_take_any_views(name, views):
    assert objections(name, "random", views=views) == []
