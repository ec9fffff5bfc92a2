"""A plugin that fails in one of its hooks: the observer `faulty`."""

import os
from collections import Counter
from collections.abc import Callable, Generator
from typing import Any, Literal

from crossgrad_core.contract.hooks import HookSpecs
from crossgrad_core.plugin import Field, Observer, hookimpl

ERRORS = {"RuntimeError": RuntimeError, "MemoryError": MemoryError, "OSError": OSError}
_CALLS: Counter[str] = Counter()
HOOKS = tuple(name for name in vars(HookSpecs) if name.startswith("crossgrad_"))


def _failing(name: str) -> Callable[..., Any]:
    @hookimpl(wrapper=True, specname=name)
    def hook(self: "Faulty") -> Generator[None, Any, Any]:
        _CALLS[name] += 1
        due = name == self.hook and _CALLS[name] >= self.call
        if due and "FAULTY_OFF" not in os.environ:
            raise ERRORS[self.error](f"put into {name}")
        return (yield)

    hook.__name__ = hook.__qualname__ = name
    return hook


class _Options(Observer):
    """What fails, and when."""

    hook: str = Field("", description="the hook that fails")
    call: int = Field(1, ge=1, description="... from this call on")
    error: Literal["RuntimeError", "MemoryError", "OSError"] = Field(
        "RuntimeError", description="what is raised"
    )


Faulty = type(_Options)("Faulty", (_Options,), {
    "__doc__": "Fails in one of its hooks.",
    "__module__": __name__,
    **{name: _failing(name) for name in HOOKS},
})  # fmt: skip
