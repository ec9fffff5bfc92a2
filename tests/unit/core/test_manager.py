"""One manager per run; hooks that pluggy would silently never call; hooks that must answer."""

import types

import pluggy
import pytest
from pydantic import BaseModel, ConfigDict

from crossgrad_core.contract.component import PROJECT
from crossgrad_core.contract.contexts import DensifyResult, SampleResult, ViewSample
from crossgrad_core.errors import UserError
from crossgrad_core.plugin import NO_EDIT, Edit, hookimpl
from crossgrad_core.registry.manager import call_first_result, make_manager
from crossgrad_operators.projection import PCGrad
from crossgrad_plugins.densifiers.adc import AdaptiveDensityControl


class Densifier:
    def __init__(self, answer):
        self.answer = answer

    @hookimpl
    def crossgrad_densify(self, context):
        return self.answer


class Recorder:
    """Wraps the hook and notes the order of events."""

    def __init__(self, name, events):
        self.name, self.events = name, events

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        self.events.append(f"{self.name} before")
        answer = yield
        self.events.append(f"{self.name} after")
        return answer


class Forgetful:
    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        yield


def refusal(**plugins):
    with pytest.raises(UserError) as caught:
        make_manager(plugins)
    return caught.value


def test_every_new_manager_is_empty():
    one, other = make_manager({"a": Densifier(1)}), make_manager({})
    assert one.get_plugin("a") is not None
    assert other.get_plugin("a") is None


def test_a_misspelt_hook_is_refused_with_a_suggestion():
    class Misspelt:
        @hookimpl
        def crossgrad_densfy(self, context):
            return None

    error = refusal(grow=Misspelt())
    assert "plugin grow implements the hook crossgrad_densfy" in error.what
    assert "did you mean 'crossgrad_densify'?" in error.todo
    assert "Misspelt" in error.where


def test_a_hook_with_another_prefix_is_refused():
    class Other:
        @hookimpl
        def densify(self, context):
            return None

    assert "the hook densify, which does not exist" in refusal(other=Other()).what


def test_a_hook_method_without_its_decorator_is_refused():
    class Unmarked:
        def crossgrad_step_end(self, record):
            return None

    error = refusal(silent=Unmarked())
    assert "method crossgrad_step_end of plugin" in error.what
    assert "add the decorator @hookimpl" in error.todo


def test_a_class_method_that_only_looks_like_a_hook_is_refused():
    class Unmarked:
        @classmethod
        def crossgrad_step_ended(cls):
            return None

    assert "did you mean 'crossgrad_step_end'?" in refusal(silent=Unmarked()).todo


def test_specname_and_optional_hooks_are_accepted():
    class Modern:
        @hookimpl(specname="crossgrad_log")
        def say(self, text):
            return None

        @hookimpl(optionalhook=True)
        def crossgrad_of_tomorrow(self, anything):
            return None

    assert make_manager({"modern": Modern()}).hook.crossgrad_log.get_hookimpls()


def test_wrong_arguments_are_refused_with_the_signature():
    class Wrong:
        @hookimpl
        def crossgrad_log(self, message):
            return None

    error = refusal(wrong=Wrong())
    assert error.what == "plugin wrong cannot be registered"
    assert "crossgrad_log" in error.found
    assert "message" in error.found


def test_a_hook_that_two_plugins_answer_is_refused_with_both_names():
    error = refusal(selected=Densifier(1), intruder=Densifier(2))
    assert "crossgrad_densify: selected, intruder" in error.what
    assert "wrapper=True" in error.todo


def test_several_plugins_may_observe_an_event():
    class Watcher:
        @hookimpl
        def crossgrad_log(self, text):
            return None

    manager = make_manager({"one": Watcher(), "two": Watcher()})
    assert len(manager.hook.crossgrad_log.get_hookimpls()) == 2


def test_a_plugin_module_that_imports_crossgrad_core_is_accepted():
    module = types.ModuleType("a_plugin")
    exec("import crossgrad_core\ncrossgrad_version = '1'", module.__dict__)
    assert make_manager({"module": module}).get_plugin("module") is module


def test_properties_of_a_plugin_are_not_evaluated():
    class Careful(BaseModel):
        model_config = ConfigDict(frozen=True)

        @property
        def crossgrad_price(self):
            raise RuntimeError("too expensive")

    make_manager({"careful": Careful()})


def test_later_wrappers_are_outer_wrappers():
    events = []
    answer = DensifyResult(NO_EDIT)
    manager = make_manager(
        {
            "densifier": Densifier(answer),
            "first": Recorder("first", events),
            "second": Recorder("second", events),
        }
    )
    assert call_first_result(manager.hook.crossgrad_densify, None, DensifyResult) is answer
    assert events == ["second before", "first before", "first after", "second after"]


@pytest.mark.parametrize("answer", [DensifyResult(NO_EDIT), DensifyResult(Edit())])
def test_a_hook_call_returns_the_answer_of_its_plugin(answer):
    hook = make_manager({"densifier": Densifier(answer)}).hook.crossgrad_densify
    assert call_first_result(hook, None, DensifyResult) is answer


@pytest.mark.parametrize(
    "answer", [None, NO_EDIT, DensifyResult(None), SampleResult(ViewSample((0,)))], ids=str
)
def test_a_hook_that_is_not_answered_is_an_error(answer):
    hook = make_manager({"densifier": Densifier(answer)}).hook.crossgrad_densify
    with pytest.raises(UserError, match="a first-result hook must return a value") as caught:
        call_first_result(hook, None, DensifyResult)
    assert caught.value.where == "plugins densifier"
    assert "NO_EDIT" in caught.value.todo


def test_a_sample_result_without_views_is_refused():
    class Sampler:
        @hookimpl
        def crossgrad_sample_views(self, context):
            return SampleResult(None)

    hook = make_manager({"sampler": Sampler()}).hook.crossgrad_sample_views
    with pytest.raises(UserError, match="crossgrad_sample_views"):
        call_first_result(hook, None, SampleResult)


def test_a_wrapper_that_drops_the_answer_is_named_in_an_error():
    plugins = {"densifier": Densifier(DensifyResult(NO_EDIT)), "forgetful": Forgetful()}
    with pytest.raises(UserError, match="no plugin returned a result") as caught:
        call_first_result(make_manager(plugins).hook.crossgrad_densify, None, DensifyResult)
    assert "forgetful" in caught.value.where
    assert "yield" in caught.value.todo


def test_an_error_in_a_hook_names_its_plugin_and_passes_through_the_wrappers():
    class Failing:
        @hookimpl
        def crossgrad_densify(self, context):
            raise ValueError("no")

    class Around:
        @hookimpl(wrapper=True)
        def crossgrad_densify(self, context):
            return (yield)

    class After:
        @hookimpl(wrapper=True)
        def crossgrad_densify(self, context):
            yield
            raise LookupError("never")

    hook = make_manager({"failing": Failing(), "around": Around()}).hook
    with pytest.raises(ValueError, match="no") as caught:
        hook.crossgrad_densify(context=None)
    (note,) = caught.value.__notes__
    assert note.startswith("in hook crossgrad_densify of plugin failing, ")
    answering = Densifier(DensifyResult(NO_EDIT))
    hook = make_manager({"one": answering, "after": After(), "around": Around()}).hook
    with pytest.raises(LookupError) as caught:
        hook.crossgrad_densify(context=None)
    (note,) = caught.value.__notes__
    assert "of plugin after, " in note


def test_calling_a_hook_without_plugins_is_an_error():
    with pytest.raises(UserError, match="plugins none"):
        call_first_result(make_manager({}).hook.crossgrad_densify, None, DensifyResult)


class Marked:
    @hookimpl
    def plain(self): ...

    @staticmethod
    @hookimpl
    def inner(): ...

    @hookimpl
    @staticmethod
    def outer(): ...

    @classmethod
    @hookimpl
    def of_class(cls): ...

    @property
    def evaluated(self):
        raise AssertionError("a property is not evaluated")

    def unmarked(self): ...


class Inherited(Marked):
    def plain(self): ...


class Slotted:
    __slots__ = ("held",)

    def __init__(self, held):
        self.held = held


def with_own_attribute():
    plugin = Marked()
    plugin.own = Marked.plain
    plugin.bound = plugin.plain
    return plugin


def module():
    found = types.ModuleType("plugin")
    found.plain = Marked.plain
    return found


@pytest.mark.parametrize(
    "plugin",
    [
        Marked(), Inherited(), Inherited, Slotted(Marked.plain), Slotted(3), with_own_attribute(),
        module(), AdaptiveDensityControl(), PCGrad(), object(),
    ],
    ids=lambda plugin: type(plugin).__name__,
)  # fmt: skip
def test_hooks_are_recognised_exactly_as_by_pluggy(plugin):
    ours, plain = make_manager({}), pluggy.PluginManager(PROJECT)
    for name in dir(plugin):
        assert ours.parse_hookimpl_opts(plugin, name) == plain.parse_hookimpl_opts(plugin, name)
