"""Listing without importing, and loud loading."""

import sys

import pytest
from support.distributions import write_distribution

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.errors import UserError
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import GROUPS, strays
from crossgrad_core.run.assemble import check_names
from crossgrad_core.system.version import VERSION

GOOD = """
from functools import wraps
from pydantic import Field
from crossgrad_core.plugin import GroupingRule, Grouping

def helped(function):
    @wraps(function)
    def wrapper(*arguments):
        return function(*arguments, "help")
    return wrapper

class Good(Grouping):
    share: float = Field(0.5, gt=0, lt=1, description="share of near views")
    seed: int = Field(3, ge=0, description="seed")

    def fit(self, scene, rng, probe=None):
        return GroupingRule(lambda views: ("near",) * len(views))

class Demanding(Good):
    file: str = Field(description="a file")

class Unfinished(Grouping):
    pass

class Few(Good):
    def fit(self, scene):
        return GroupingRule(lambda views: ("near",) * len(views))

class Many(Good):
    def fit(self, scene, rng, probe, more):
        return GroupingRule(lambda views: ("near",) * len(views))

class Without(Good):
    def fit(self, scene, rng):
        return GroupingRule(lambda views: ("near",) * len(views))

class Any(Good):
    def fit(self, *arguments, **more):
        return GroupingRule(lambda views: ("near",) * len(views))

class Static(Good):
    @staticmethod
    def fit(scene, rng, probe=None):
        return GroupingRule(lambda views: ("near",) * len(views))

class Decorated(Good):
    @helped
    def fit(self, scene, rng, probe, helper):
        return GroupingRule(lambda views: ("near",) * len(views))

class Own(Good):
    def copy(self):
        return self

something = 7
"""


OTHERS = ("few", "many", "without", "any", "static", "decorated", "own")


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Puts made-up distributions on the path; forgets their modules afterwards."""
    before = set(sys.modules)

    def put(name, plugins, modules=None, version="1.0", requires=""):
        folder = tmp_path / f"{name}-{version}"
        write_distribution(folder, name, plugins, modules, version, requires)
        monkeypatch.syspath_prepend(folder)

    yield put
    for module in set(sys.modules) - before:
        if module.startswith("made_up"):
            del sys.modules[module]


@pytest.fixture
def good(install):
    plugins = {
        "good": "made_up:Good",
        "demanding": "made_up:Demanding",
        "unfinished": "made_up:Unfinished",
        "seven": "made_up:something",
        **{name: f"made_up:{name.title()}" for name in OTHERS},
        "gone": "made_up:Gone",
        "lost": "made_up_lost:Lost",
    }
    install("made-up", {"groupings": plugins}, {"made_up": GOOD})


def refusal(slot, name, options=None):
    with pytest.raises(UserError) as caught:
        registry.build(slot, name, options or {})
    return caught.value


def test_every_slot_lists_its_bundled_components():
    for slot in GROUPS:
        ours = [
            each for each in registry.entries(slot).values() if each.distribution == "crossgrad"
        ]
        assert ours, slot
        assert all(each.slot == slot and ":" in each.value for each in ours)


def test_entries_are_sorted_and_name_their_package(install):
    install("made-up", {"observers": {"zz": "m:A", "aa": "m:B"}}, version="2.5")
    names = list(registry.entries("observers"))
    assert names == sorted(names)
    entry = registry.entries("observers")["aa"]
    assert entry == registry.Entry("aa", "observers", "m:B", "made-up", "2.5")
    assert entry.origin == "m:B, from made-up 2.5"


def test_a_package_installed_later_is_found(install):
    assert "later" not in registry.entries("observers")
    install("made-up", {"observers": {"later": "m:A"}})
    assert "later" in registry.entries("observers")


def test_listing_imports_no_plugin(good):
    registry.entries("groupings")
    assert "made_up" not in sys.modules


def test_an_unknown_slot_is_a_programming_error():
    with pytest.raises(KeyError):
        registry.entries("operator")


def test_a_valid_plugin_is_built_with_its_options(good):
    component = registry.build("groupings", "good", {"share": 0.25})
    assert isinstance(component, Grouping)
    assert component.model_dump() == {"share": 0.25, "seed": 3}


def test_an_unknown_name_is_refused_with_a_suggestion(good):
    error = refusal("groupings", "god")
    assert "no grouping named 'god'" in error.what
    assert "good" in error.expected
    assert "radial" in error.expected
    assert "did you mean 'good'?" in error.todo


def test_the_error_for_a_name_of_another_slot_names_the_other_slot():
    assert (
        "a component with the name radial exists in the slot grouping"
        in refusal("operators", "radial").todo
    )


def test_a_name_that_two_packages_offer_is_refused_with_both_packages(good, install):
    install("other-made-up", {"groupings": {"good": "elsewhere:Good"}}, version="3.0")
    error = refusal("groupings", "good")
    assert "2 installed packages offer a grouping named 'good'" in error.what
    assert "made-up 1.0" in error.found
    assert "other-made-up 3.0" in error.found


def test_a_name_clash_with_crossgrad_asks_the_other_package_to_rename(install):
    install("made-up", {"samplers": {"random": "elsewhere:Good"}})
    error = refusal("samplers", "random")
    assert "rename the plugin in made-up" in error.todo


def test_components_of_other_packages_are_listed_with_their_versions(good):
    names = {"groupings": ["good", "radial", "missing"], "samplers": ["random"]}
    assert registry.from_elsewhere(names) == ("from made-up 1.0: grouping good",)
    assert registry.from_elsewhere({"groupings": ["radial"]}) == ()


def test_the_failed_package_is_named_correctly_if_two_packages_share_a_folder(install):
    source = GOOD + "\ndef fail():\n    raise ValueError('no')\n"
    modules = {"made_up_of_two/a": GOOD, "made_up_of_two/b": source}
    install("a-made-up", {"groupings": {"a": "made_up_of_two.a:Good"}}, modules)
    install("b-made-up", {"groupings": {"b": "made_up_of_two.b:Good"}})
    registry.load("groupings", "b")
    with pytest.raises(ValueError, match="no") as failed:
        sys.modules["made_up_of_two.b"].fail()
    told = registry.failed_plugin(failed.value)
    assert told is not None and "b-made-up" in told.what


def test_the_first_copy_of_a_package_on_the_path_is_used(install):
    install("made-up", {"observers": {"copy": "old:A"}}, version="1.0")
    install("made_up", {"observers": {"copy": "new:A"}}, version="1.1")
    assert registry.find("observers", "copy").value == "new:A"


@pytest.mark.parametrize(
    ("name", "original"),
    [
        ("lost", "ModuleNotFoundError: No module named 'made_up_lost'"),
        ("gone", "AttributeError: module 'made_up' has no attribute 'Gone'"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_named(good, name, original):
    error = refusal("groupings", name)
    assert f"grouping {name} cannot be imported" in error.what
    assert "from made-up 1.0" in error.where
    assert error.found == original
    assert isinstance(error.__cause__, Exception)


def test_a_broken_plugin_stops_only_runs_that_use_it(good):
    refusal("groupings", "lost")
    assert registry.build("groupings", "good", {})


def test_an_import_error_of_several_lines_is_reported_in_one_line(install):
    source = 'raise RuntimeError("first\\n  second")'
    install("made-up", {"observers": {"noisy": "made_up_noisy:A"}}, {"made_up_noisy": source})
    assert refusal("observers", "noisy").found == "RuntimeError: first second"


def test_a_user_error_raised_at_import_of_a_plugin_is_passed_on(install):
    source = (
        "from crossgrad_core.errors import UserError\n"
        "raise UserError('gpu needs CUDA', todo='install it')"
    )
    install("made-up", {"observers": {"gpu": "made_up_gpu:A"}}, {"made_up_gpu": source})
    assert refusal("observers", "gpu").what == "gpu needs CUDA"


@pytest.mark.parametrize(
    ("name", "found"), [("seven", "7"), ("unfinished", "Unfinished without the methods fit")]
)
def test_an_object_that_is_not_a_component_is_refused(good, name, found):
    error = refusal("groupings", name)
    assert error.expected == "a complete subclass of crossgrad_core.plugin.Grouping"
    assert error.found == found


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("few", "fit(self, scene)"),
        ("many", "fit(self, scene, rng, probe, more)"),
        ("without", "fit(self, scene, rng)"),
    ],
)
def test_methods_with_incompatible_signatures_are_refused(good, name, found):
    error = refusal("groupings", name)
    assert error.found == found
    assert error.expected.startswith("fit(self, scene: ")
    assert "from made-up 1.0" in error.where and "made_up.py:" in error.where


@pytest.mark.parametrize("name", ["any", "static", "decorated", "own"])
def test_methods_with_a_compatible_signature_are_accepted(good, name):
    assert registry.build("groupings", name, {})


@pytest.mark.parametrize("slot", GROUPS)
def test_all_bundled_components_have_compatible_signatures(slot):
    for name in registry.entries(slot):
        registry.load(slot, name)


def test_a_component_of_another_slot_is_refused(install):
    install("made-up", {"observers": {"wrong": "made_up:Good"}}, {"made_up": GOOD})
    assert "crossgrad_core.plugin.Observer" in refusal("observers", "wrong").expected


def test_an_unknown_option_is_refused_with_a_suggestion(good):
    error = refusal("groupings", "good", {"shar": 0.5})
    assert error.what == "grouping good has no option 'shar'"
    assert error.where == "grouping.shar"
    assert error.expected == "one of share, seed"
    assert "did you mean 'share'?" in error.todo
    assert "crossgrad plugins show good" in error.todo


def test_a_value_out_of_bounds_is_refused_and_the_value_is_shown(good):
    error = refusal("groupings", "good", {"share": 1.5})
    assert error.what == "option share of grouping good is not valid"
    assert error.expected == "less than 1"
    assert error.found == "1.5 (float)"


@pytest.mark.parametrize(
    "requires",
    ["crossgrad>=0.1,<0.2", "Crossgrad [geo] == 0.1.*", "crossgrad>9; python_version>'3'"],
)
def test_a_package_for_another_version_of_crossgrad_is_refused(install, requires):
    plugins = {"groupings": {"dated": "made_up_dated:Good"}}
    install("made-up", plugins, {"made_up_dated": GOOD}, "1.4", requires)
    error = refusal("groupings", "dated")
    assert "grouping dated was written for another version of crossgrad" in error.what
    assert error.expected.startswith("crossgrad") and "made-up 1.4 requires" in error.expected
    assert error.found == f"crossgrad {VERSION}"
    assert "made_up_dated" not in sys.modules
    with pytest.raises(UserError, match="another version of crossgrad"):
        check_names(RunConfig(grouping={"name": "dated"}))


@pytest.mark.parametrize(
    "requires",
    [
        "", "crossgrad", "crossgrad>=0.2,<0.3", "crossgrad-example<0.1", "crossgrad ==",
        "crossgrad<0.1; extra == 'old'", "numpy<1",
    ],
)  # fmt: skip
def test_a_package_for_this_version_of_crossgrad_is_accepted(install, requires):
    install("made-up", {"groupings": {"good": "made_up:Good"}}, {"made_up": GOOD}, "1.4", requires)
    assert registry.build("groupings", "good", {})


@pytest.mark.parametrize(
    ("group", "meant"),
    [
        ("operator", "crossgrad.operators"),
        ("backbone", "crossgrad.backbones"),
        ("loss", "crossgrad.losses"),
        ("Observers", "crossgrad.observers"),
        ("opperators", "crossgrad.operators"),
    ],
)
def test_a_misspelt_entry_point_group_is_named_with_a_suggestion(install, group, meant):
    install("made-up", {group: {"lost": "made_up:Good"}, "observers": {"seen": "made_up:Good"}})
    (stray,) = [each for each in strays() if each.distribution == "made-up"]
    assert (stray.name, stray.group, stray.meant) == ("lost", f"crossgrad.{group}", meant)
    error = refusal("operators", "lost")
    assert f"made-up 1.0 offers lost, but the entry-point group crossgrad.{group}" in error.todo
    assert f"write {meant}" in error.todo


def test_entry_point_groups_of_other_programs_are_ignored():
    assert list(strays()) == []


def test_a_missing_option_is_named(good):
    error = refusal("groupings", "demanding")
    assert error.where == "grouping.file"
    assert error.found == "nothing"


def test_several_wrong_options_are_all_named(good):
    error = refusal("groupings", "good", {"share": 1.5, "seed": -1})
    assert "also wrong: seed" in error.todo


def test_errors_about_observer_options_name_the_observer():
    error = refusal("observers", "progress", {"intervall": 3})
    assert error.where == "observers.progress.intervall"
