"""The base class of all components, and the decorators that mark hooks."""

from dataclasses import dataclass
from typing import ClassVar, TypeVar

import pluggy
from pydantic import BaseModel, ConfigDict
from typing_extensions import override

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.errors import UserError

A = TypeVar("A")
B = TypeVar("B")
PROJECT = "crossgrad"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


class Component(BaseModel):
    """Base class of all components; a component fills a slot.

    The fields of a component are its options. Each option has a type, bounds and a description. A
    component never stores the state of a run. Its methods receive and return the state as
    `PluginState`.

    Attributes:
        slot: The slot that the component fills; set by the slot's base class.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    slot: ClassVar[str]


def answered(answer: object, kind: type[A], component: Component, method: str) -> A:
    """Return the result of a component's method after a check of its type.

    Raises:
        UserError: The result has another type. The message names the method.
    """
    if isinstance(answer, kind):
        return answer
    raise _wrong_answer(component, method, kind.__name__, answer)


def pair(
    answer: object, first: type[A], second: type[B], component: Component, method: str
) -> tuple[A, B]:
    """Return the pair that a component's method returned, after a check of both types.

    Raises:
        UserError: The result is not a pair of these types. The message names the method.
    """
    match answer:
        case (one, other) if isinstance(one, first) and isinstance(other, second):
            return one, other
    wanted = f"a pair: {first.__name__}, {second.__name__}"
    raise _wrong_answer(component, method, wanted, answer)


def with_state(
    answer: object, kind: type[A], component: Component, method: str
) -> tuple[A, PluginState]:
    """Return the result of a component's method and the new state, after a check of both types."""
    return pair(answer, kind, PluginState, component, method)


def _wrong_answer(component: Component, method: str, expected: str, answer: object) -> UserError:
    component_class = type(component)
    parts = [type(item).__name__ for item in answer] if isinstance(answer, tuple) else []
    return UserError(
        f"{component_class.__name__}.{method} returned a value of a wrong type",
        where=f"{component_class.__module__}:{component_class.__qualname__}.{method}",
        expected=expected,
        found=f"a tuple: {', '.join(parts)}" if parts else type(answer).__name__,
        todo="repair the plugin, or choose another component",
    )


@dataclass(frozen=True)
class ViewCounts:
    """The numbers K of views per step that a component supports.

    Attributes:
        minimum: Smallest K.
        maximum: Largest K; None for no limit.
        multiple_of: K must be a multiple of this number.
    """

    minimum: int = 1
    maximum: int | None = None
    multiple_of: int = 1

    def admits(self, views: int) -> bool:
        """Return True if K = `views` is supported."""
        above = self.maximum is not None and views > self.maximum
        return views >= self.minimum and not above and views % self.multiple_of == 0

    @override
    def __str__(self) -> str:
        if self.maximum == self.minimum:
            return f"K = {self.minimum}"
        parts = [f"K >= {self.minimum}"]
        if self.maximum is not None:
            parts = [f"{self.minimum} <= K <= {self.maximum}"]
        if self.multiple_of > 1:
            parts.append(f"K a multiple of {self.multiple_of}")
        return ", ".join(parts)
