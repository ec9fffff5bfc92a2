"""One plugin manager per run, and calls of first-result hooks, which must return a result.

The library pluggy does not report an unknown hook, a hook method without its marker, or a second
plugin that answers a first-result hook. This module reports these three mistakes as errors that
name the plugin.
"""

import inspect
from collections.abc import Callable, Generator, Mapping
from types import FunctionType, MemberDescriptorType, MethodType
from typing import Any, TypeVar, cast

import pluggy
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.blocks import Edit
from crossgrad_core.contract.component import PROJECT, Component
from crossgrad_core.contract.contexts import (
    Answer,
    DensifyResult,
    RegularizeResult,
    SampleResult,
    StepContext,
)
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.hooks import HookSpecs
from crossgrad_core.contract.slots.rule import GaussiansResult
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import installed_as
from crossgrad_core.wording import did_you_mean, listed, sentences, singular

A = TypeVar("A", bound=Answer)

_PREFIX = "crossgrad_"
_HOOKS = tuple(name for name in vars(HookSpecs) if name.startswith(_PREFIX))
_MARK = f"{PROJECT}_impl"


class _Manager(pluggy.PluginManager):
    """A manager that passes to pluggy only the attributes that can be hooks.

    A component has about a hundred attributes. If pluggy examined all attributes, every start would
    take 0.3 s longer.
    """

    def __init__(self, project: str) -> None:
        super().__init__(project)
        self._asked: tuple[object, frozenset[str]] = (None, frozenset())

    @override
    def parse_hookimpl_opts(self, plugin: object, name: str) -> Any:
        # Store the names of one plugin only, because pluggy reads all methods of a plugin before
        # the next plugin.
        if self._asked[0] is not plugin:
            self._asked = plugin, _may_be_hooks(plugin)
        return super().parse_hookimpl_opts(plugin, name) if name in self._asked[1] else None


def make_manager(plugins: Mapping[str, object]) -> pluggy.PluginManager:
    """Return a new manager with the hooks and the given plugins registered.

    Args:
        plugins: Name -> plugin. If two plugins wrap one hook, the later plugin is the outer
            wrapper.

    Raises:
        UserError: A plugin has a hook that does not exist, a hook method without `@hookimpl`, or a
            hook method with wrong arguments. Also if two plugins answer the same first-result hook.
    """
    manager = _Manager(PROJECT)
    manager.add_hookspecs(HookSpecs)
    for name, plugin in plugins.items():
        _refuse_misspelt_hooks(manager, name, plugin)
        try:
            manager.register(plugin, name=name)
        except (pluggy.PluginValidationError, ValueError) as error:
            raise UserError(
                f"plugin {name} cannot be registered",
                where=_class_of(plugin),
                found=" ".join(str(error).split()),
                todo="docs/hooks.md lists every hook with its arguments",
            ) from error
        _note_failures(manager, name, plugin)
    _refuse_second_answers(manager)
    return manager


def call_first_result(hook: pluggy.HookCaller, context: StepContext, answer: type[A]) -> A:
    """Call a first-result hook and return its answer, after a check of the answer's type.

    Args:
        hook: A hook that stops at the first answer, such as `manager.hook.crossgrad_densify`.
        context: The argument that the plugins receive.
        answer: Type of the answer.

    Raises:
        UserError: No plugin answered, or the answer is of another type.
    """
    result: object = hook(context=context)
    if isinstance(result, answer) and _complete(result):
        return result
    raise UserError(
        f"no plugin returned a result for the hook {hook.name}",
        where=f"plugins {listed(impl.plugin_name for impl in hook.get_hookimpls())}",
        expected=f"a value of type {answer.__name__}; a first-result hook must return a value",
        found=repr(result),
        todo="return a value, such as NO_EDIT for no change; a wrapper must return the "
        "value that `yield` gave it, or a replacement",
    )


def call_all(hook: pluggy.HookCaller, context: StepContext, answer: type[A]) -> list[A]:
    """Call a hook that several plugins answer and return all answers, after a check of their types.

    Args:
        hook: A hook that all plugins answer, such as `manager.hook.crossgrad_after_step`.
        context: The argument that the plugins receive.
        answer: Type of the answers.

    Raises:
        UserError: An answer is of another type.
    """
    results: list[object] = hook(context=context)
    for result in results:
        if not isinstance(result, answer) or not _complete(result):
            raise wrong_answer(hook, f"a value of type {answer.__name__}, or None", repr(result))
    return cast("list[A]", results)


def wrong_answer(hook: pluggy.HookCaller, expected: str, found: str) -> UserError:
    """Return the error for a hook's answer that the run cannot use."""
    return UserError(
        f"a plugin returned a value of a wrong type for the hook {hook.name}",
        where=f"one of {listed(impl.plugin_name for impl in hook.get_hookimpls())}",
        expected=expected,
        found=found,
        todo="repair the plugin (docs/hooks.md), or run without this plugin",
    )


def one_by_one(manager: pluggy.PluginManager, name: str) -> tuple[pluggy.HookCaller, ...]:
    """Return a caller for each plugin that answers a hook, in the order of registration.

    Each caller calls one plugin, so that the next plugin can receive the answer of the previous
    plugin. Every call also runs the wrappers of the hook.
    """
    answering = [
        implementation.plugin
        for implementation in getattr(manager.hook, name).get_hookimpls()
        if not (implementation.wrapper or implementation.hookwrapper)
    ]
    return tuple(
        manager.subset_hook_caller(name, [other for other in answering if other is not plugin])
        for plugin in answering
    )


def _note_failures(manager: pluggy.PluginManager, name: str, plugin: object) -> None:
    """Add the names of the hook and the plugin to exceptions that the hooks of a plugin raise."""
    whose = _described(name, plugin)
    for caller in manager.get_hookcallers(plugin) or ():
        for implementation in caller.get_hookimpls():
            if implementation.plugin is plugin:
                noted = _noted(implementation.function, f"in hook {caller.name} of {whose}")
                implementation.function = noted  # type: ignore[misc]


def _noted(function: Callable[..., Any], note: str) -> Callable[..., Any]:
    """Return a function or generator function that adds the note to the function's exceptions."""

    def call(*arguments: object) -> object:
        try:
            return function(*arguments)
        except (Exception, SystemExit) as error:
            _add_note(error, note)
            raise

    def wrap(*arguments: object) -> Generator[None, object, object]:
        try:
            return (yield from function(*arguments))
        except (Exception, SystemExit) as error:
            _add_note(error, note)
            raise

    return wrap if inspect.isgeneratorfunction(function) else call


def _add_note(error: BaseException, note: str) -> None:
    # An exception that passed through a wrapper was raised by another plugin and already has a
    # note.
    if not any(
        present_note.startswith("in hook ") for present_note in getattr(error, "__notes__", ())
    ):
        error.add_note(note)


def _described(name: str, plugin: object) -> str:
    entry = installed_as(type(plugin)) if isinstance(plugin, Component) else None
    if entry is None:
        return f"plugin {name}, {_class_of(plugin)}"
    return f"{singular(entry.slot)} {entry.name}, from {entry.distribution} {entry.version}"


def _complete(answer: Answer) -> bool:
    """Return True if an answer contains a value of the right type; None is a wrong value."""
    match answer:
        case SampleResult():
            return bool(answer.draw)
        case DensifyResult():
            return isinstance(answer.edit, Edit)
        case GaussiansResult():
            return isinstance(answer.gaussians, Gaussians)
        case RegularizeResult():
            return isinstance(answer.loss, Tensor) and answer.loss.numel() == 1
        case _:
            return True


def _refuse_misspelt_hooks(manager: pluggy.PluginManager, name: str, plugin: object) -> None:
    """Raise an error for hooks that do not exist; this replaces pluggy's own `check_pending`.

    `check_pending` sees only marked methods and does not suggest a name.
    """
    for attribute in dir(plugin):
        options = manager.parse_hookimpl_opts(plugin, attribute)
        if options is None:
            if attribute.startswith(_PREFIX) and _is_function(plugin, attribute):
                raise _unmarked(name, plugin, attribute)
        elif not options.get("optionalhook"):
            hook = options.get("specname") or attribute
            if hook not in _HOOKS:
                raise _no_such_hook(name, plugin, hook)


def _may_be_hooks(plugin: object) -> frozenset[str]:
    """Return the names of attributes that are marked as hooks, or that only pluggy can check."""
    if inspect.isclass(plugin) or inspect.ismodule(plugin):
        return frozenset(dir(plugin))
    attributes: dict[str, object] = {}
    for kind in reversed(type(plugin).__mro__):
        attributes |= vars(kind)
    instance_attributes = getattr(plugin, "__dict__", {})
    return frozenset(name for name, value in attributes.items() if _may_be_hook(value)).union(
        instance_attributes
    )


def _may_be_hook(attribute: object) -> bool:
    """Return True if a class attribute is marked as a hook, or if only pluggy can check it."""
    if isinstance(attribute, FunctionType):
        return hasattr(attribute, _MARK)
    if isinstance(attribute, staticmethod | classmethod | MethodType):
        return hasattr(attribute, _MARK) or hasattr(attribute.__func__, _MARK)
    return isinstance(attribute, MemberDescriptorType)


def _is_function(plugin: object, attribute: str) -> bool:
    value = inspect.getattr_static(plugin, attribute, None)
    return inspect.isroutine(value)


def _unmarked(name: str, plugin: object, attribute: str) -> UserError:
    if attribute not in _HOOKS:
        return _no_such_hook(name, plugin, attribute)
    return UserError(
        f"method {attribute} of plugin {name} would never be called",
        where=_class_of(plugin),
        expected="a hook marked with @hookimpl",
        found="a method without @hookimpl",
        todo="add the decorator @hookimpl: `from crossgrad_core.plugin import hookimpl`",
    )


def _no_such_hook(name: str, plugin: object, hook: str) -> UserError:
    return UserError(
        f"plugin {name} implements the hook {hook}, which does not exist",
        where=_class_of(plugin),
        expected=f"one of {listed(_HOOKS)}",
        todo=sentences(
            did_you_mean(hook, _HOOKS), f"names that begin with {_PREFIX} are reserved for hooks"
        ),
    )


def _refuse_second_answers(manager: pluggy.PluginManager) -> None:
    """Refuse two plugins that answer one first-result hook; only one answer would be used."""
    for hook in _HOOKS:
        caller: pluggy.HookCaller = getattr(manager.hook, hook)
        spec = caller.spec
        answering = [
            impl.plugin_name
            for impl in caller.get_hookimpls()
            if not impl.wrapper and not impl.hookwrapper
        ]
        if spec is not None and spec.opts["firstresult"] and len(answering) > 1:
            raise UserError(
                f"{len(answering)} plugins implement the first-result hook {hook}: "
                f"{listed(answering)}",
                expected="one implementation, by the component of the slot",
                todo="mark the other implementations as wrappers, @hookimpl(wrapper=True), or run "
                "without these plugins",
            )


def _class_of(plugin: object) -> str:
    kind = type(plugin)
    return f"{kind.__module__}:{kind.__qualname__}"
