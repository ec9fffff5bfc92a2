"""File < options < --set, and what a choice of components keeps and drops."""

import pytest

from crossgrad_core.config import ComponentChoice
from crossgrad_core.errors import UserError
from crossgrad_core.plugin import Observer
from crossgrad_core.registry.entries import entries, load
from crossgrad_core.registry.slots import GROUPS, LISTS
from crossgrad_core.run.settings import merged, parsed
from crossgrad_core.wording import singular

CONFIG = """
steps: 100
operator: {name: cagrad, c: 0.4}
observers: [progress, {name: rate, every: 10}]
data: {max_size: 640}
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(CONFIG)
    return path


def written(tmp_path, text):
    path = tmp_path / "other.yaml"
    path.write_text(text)
    return path


def refusal(*arguments):
    with pytest.raises(UserError) as caught:
        merged(*arguments)
    return caught.value


def test_no_options_give_an_empty_configuration():
    assert merged(None, {"steps": None, "observe": None, "scene": None}, []) == {}


def test_a_file_is_read_and_its_component_choices_are_expanded(config):
    assert merged(config, {}, []) == {
        "steps": 100,
        "operator": {"name": "cagrad", "c": 0.4},
        "observers": [{"name": "progress"}, {"name": "rate", "every": 10}],
        "data": {"max_size": 640},
    }


def test_options_override_the_file_and_assignments_override_both(config):
    assert merged(config, {"steps": 200}, [])["steps"] == 200
    assert merged(config, {"steps": 200}, ["steps=300"])["steps"] == 300


@pytest.mark.parametrize(
    ("options", "assignments", "clock"),
    [
        ({"steps": 5}, [], None),
        ({}, ["max_views=5"], None),
        ({"steps": 5, "clock": "cpu"}, [], "cpu"),
        ({"seconds": 5.0}, [], "cpu"),
        ({"seed": 5}, [], "cpu"),
    ],
)
def test_replacing_the_seconds_of_a_file_also_replaces_its_clock(
    tmp_path, options, assignments, clock
):
    path = tmp_path / "config.yaml"
    path.write_text("seconds: 3.0\nclock: cpu\n")
    assert merged(path, options, assignments).get("clock") == clock


def test_a_new_length_also_drops_stop_after_of_the_file(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("steps: 40\nstop_after: 20\n")
    assert merged(path, {"seed": 5}, [])["stop_after"] == 20
    assert "stop_after" not in merged(path, {"steps": 5}, [])
    assert merged(path, {"steps": 5, "stop_after": 3}, [])["stop_after"] == 3


@pytest.mark.parametrize(
    ("options", "assignments"), [({"seconds": 5.0}, []), ({}, ["seconds=5.0"])]
)
def test_a_new_length_replaces_the_length_of_the_file(tmp_path, options, assignments):
    path = tmp_path / "config.yaml"
    path.write_text("steps: 40\nrevisions: [[10, 60]]\nplanned_seconds: 3.0\nseed: 1\n")
    expected = {"seconds": 5.0, "seed": 1}
    assert merged(path, options, assignments) == expected
    kept = merged(path, {"seed": 2}, [])
    assert (kept["revisions"], kept["planned_seconds"]) == ([[10, 60]], 3.0)


def test_options_that_are_not_given_keep_the_values_of_the_file(config):
    assert merged(config, {"steps": None, "observe": []}, []) == merged(config, {}, [])


@pytest.mark.parametrize(
    ("name", "value", "place"),
    [
        ("max_size", 320, ("data", "max_size")),
        ("split", "none", ("data", "split")),
        ("test_every", 4, ("data", "test_every")),
        ("init", "random", ("data", "init")),
    ],
)
def test_options_about_the_scene_are_stored_in_their_own_group(name, value, place):
    assert merged(None, {name: value}, []) == {place[0]: {place[1]: value}}


def test_paths_are_stored_as_text(tmp_path):
    assert merged(None, {"scene": tmp_path, "out": tmp_path}, []) == {
        "scene": str(tmp_path),
        "out": str(tmp_path),
    }


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.4", 0.4),
        ("1e-3", 1e-3),
        ("3E5", 3e5),
        ("-2", -2),
        ("010", 10),
        ("true", True),
        ("no", "no"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("null", None),
        ("word", "word"),
        ("'7'", "7"),
        ("[1, 2.5]", [1, 2.5]),
        ("a=b", "a=b"),
    ],
)
def test_assigned_values_get_the_type_that_a_user_expects(text, value):
    found = merged(None, {}, [f"operator.c={text}"])["operator"]["c"]
    assert found == value
    assert type(found) is type(value)


def test_infinity_is_read_as_a_number():
    assert merged(None, {}, ["operator.c=.inf"])["operator"]["c"] == float("inf")


@pytest.mark.parametrize("how", [({"operator": "pcgrad"}, []), ({}, ["operator=pcgrad"])])
def test_another_component_drops_the_options_of_the_previous_component(config, how):
    assert merged(config, *how)["operator"] == {"name": "pcgrad"}


def test_choosing_the_same_component_again_keeps_its_options(config):
    assert merged(config, {"operator": "cagrad"}, [])["operator"] == {"name": "cagrad", "c": 0.4}


@pytest.mark.parametrize(
    "assignments",
    [["operator.name=pcgrad", "operator.x=1"], ["operator.x=1", "operator.name=pcgrad"]],
)
def test_the_order_of_assignments_does_not_matter(config, assignments):
    assert merged(config, {}, assignments)["operator"] == {"name": "pcgrad", "x": 1}


def test_options_without_a_component_name_belong_to_the_default_component():
    assignments = ["rasterizer.max_alpha=0.999", "sampler.order=epoch", "densifier.x=1"]
    assert merged(None, {}, assignments) == {
        "rasterizer": {"name": "auto", "max_alpha": 0.999},
        "sampler": {"name": "epoch", "order": "epoch"},
        "densifier": {"name": "auto", "x": 1},
    }


def test_options_without_a_name_in_a_file_belong_to_the_component_chosen_later(tmp_path):
    path = written(tmp_path, "operator: {c: 0.3}")
    assert merged(path, {"operator": "cagrad"}, [])["operator"] == {"name": "cagrad", "c": 0.3}


def test_a_chain_is_stored_as_a_list_of_choices():
    links = [{"name": "preconditioner"}, {"name": "symmetric"}]
    assert merged(None, {"operator": "preconditioner+symmetric"}, [])["operator"] == links


def test_options_of_a_chain_link_are_found_by_its_name():
    settings = merged(None, {"operator": "a+b"}, ["operator.b.c=1"])
    assert settings["operator"] == [{"name": "a"}, {"name": "b", "c": 1}]


def test_a_chain_link_keeps_its_options_in_another_chain(config):
    links = [{"name": "preconditioner"}, {"name": "cagrad", "c": 0.4}]
    assert merged(config, {"operator": "preconditioner+cagrad"}, [])["operator"] == links


def test_an_option_of_a_chain_must_name_its_link():
    error = refusal(None, {"operator": "a+b"}, ["operator.c=1"])
    assert error.expected == "operator.a.c, operator.b.c"


def test_observers_are_added_and_their_options_are_found_by_name(config):
    settings = merged(config, {"observe": ["clip", "progress"]}, ["observers.clip.max_norm=0.1"])
    assert settings["observers"] == [
        {"name": "progress"},
        {"name": "rate", "every": 10},
        {"name": "clip", "max_norm": 0.1},
    ]


def test_observers_may_be_written_as_a_mapping(tmp_path):
    path = written(tmp_path, "observers: {clip: {max_norm: 0.1}, rate: }")
    expected = [{"name": "clip", "max_norm": 0.1}, {"name": "rate"}]
    assert merged(path, {}, [])["observers"] == expected


class NotInstalled(Observer):
    """An observer that no package offers."""


def settled(**options):
    """The configuration that options make."""
    return parsed(merged(None, options, ()))


def option_of(slot):
    return {"metrics": "metrics", "observers": "observe"}.get(slot, singular(slot))


@pytest.mark.parametrize("wrong", [42, object(), True, {"name", "other"}, NotInstalled])
@pytest.mark.parametrize("slot", sorted(GROUPS))
def test_a_value_that_is_not_a_component_is_refused_in_every_slot(slot, wrong):
    for value in (wrong, [wrong], ["first", wrong]):
        with pytest.raises(UserError) as caught:
            settled(**{option_of(slot): value})
        assert caught.value.where.startswith(slot if slot in LISTS else singular(slot))
        assert caught.value.expected and caught.value.todo


@pytest.mark.parametrize("assignment", ["metrics=[42]", "observers=7", "operator=[1.5]"])
def test_a_value_that_is_not_a_component_is_refused_after_set(assignment):
    with pytest.raises(UserError, match="the name of a component"):
        parsed(merged(None, {}, [assignment]))


@pytest.mark.parametrize("slot", sorted(GROUPS))
def test_every_slot_accepts_a_name_a_mapping_a_class_or_an_instance(slot):
    name = "cagrad" if slot == "operators" else max(entries(slot))
    kind = load(slot, name)
    for given in (name, {"name": name}, kind, kind()):
        config = settled(**{option_of(slot): given})
        if slot == "rules":
            assert config.used_rules == (ComponentChoice(name=name),)
            continue
        chosen = getattr(config, slot if slot in LISTS else singular(slot))
        assert ComponentChoice(name=name) in (chosen if slot in LISTS else [chosen])


def test_an_instance_contributes_only_the_options_that_were_given():
    given = load("operators", "cagrad")(c=0.4)
    assert settled(operator=given).operator == ComponentChoice(name="cagrad", c=0.4)
    chain = settled(operator=[load("operators", "preconditioner"), given, "soft"]).operator
    assert [link.name for link in chain] == ["preconditioner", "cagrad", "soft"]
    usual = load("backbones", "vanilla")(sh_degree=3)
    assert settled(backbone=usual).backbone == ComponentChoice(name="vanilla", sh_degree=3)


def test_a_class_of_another_slot_is_refused_even_if_its_name_is_known():
    with pytest.raises(UserError, match="class Anchors cannot be used as a grouping"):
        settled(grouping=load("operators", "anchors"))


def test_options_of_a_default_component_are_kept(tmp_path):
    (metric,) = [each for each in settled(metrics=[{"name": "lpips", "trunk": "x"}]).metrics
                 if each.name == "lpips"]  # fmt: skip
    assert metric == ComponentChoice(name="lpips", trunk="x")
    path = written(tmp_path, "observers: [{name: diagnostics, every: 5, views: 4}]")
    (observer,) = merged(path, {"observe": [{"name": "diagnostics", "every": 6}]}, [])["observers"]
    assert observer == {"name": "diagnostics", "every": 6, "views": 4}
    assert merged(path, {"observe": ["diagnostics"]}, [])["observers"][0]["every"] == 5


def test_a_component_given_twice_with_different_options_is_refused(tmp_path):
    twice = [{"name": "diagnostics", "every": 5}, {"name": "diagnostics", "every": 6}]
    path = written(tmp_path, "observers: [{name: diagnostics, every: 5}, diagnostics]")
    for given in ((None, {"observe": twice}, []), (path, {}, [])):
        with pytest.raises(UserError, match="diagnostics is named twice"):
            parsed(merged(*given))
    assert len(settled(observe=["diagnostics", "diagnostics"]).observers) == 1


def test_options_of_an_observer_that_is_not_selected_are_refused():
    assert "--observe NAME" in refusal(None, {}, ["observers.clip.max_norm=1"]).todo


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("steps", "KEY=VALUE"),
        ("=3", "KEY=VALUE"),
        ("operator..c=3", "KEY=VALUE"),
        ("operator.c=[1", "not valid YAML"),
        ("steps.c=1", "has no options of its own"),
        ("steps.c.d=1", "has no options of its own"),
    ],
)
def test_malformed_assignments_are_refused(config, assignment, words):
    assert words in str(refusal(config, {}, [assignment]))


def test_unknown_keys_are_passed_on_to_the_validation():
    assert merged(None, {}, ["stepps=3", "a.b=1"]) == {"stepps": 3, "a": {"b": 1}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("steps: [1\n", "line 2"),
        ("- a\n- b\n", "contains no settings"),
        ("steps: 1\nsteps: 2\n", "'steps' occurs twice"),
    ],
)
def test_broken_files_are_refused_with_the_position_of_the_error(tmp_path, text, words):
    path = written(tmp_path, text)
    error = refusal(path, {}, [])
    assert error.where == str(path)
    assert words in str(error)


def test_a_missing_file_is_refused(tmp_path):
    assert "cannot be read" in refusal(tmp_path / "gone.yaml", {}, []).what


def test_an_empty_file_gives_an_empty_configuration(tmp_path):
    assert merged(written(tmp_path, "# nothing yet\n"), {}, []) == {}
