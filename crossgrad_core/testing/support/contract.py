"""Building blocks of contract checks.

A check is a function `check(make)`. `make()` returns a new component with default options. If the
component breaks the contract, the check raises `ContractError` with a sentence for its author.
Checks do not need pytest or hypothesis. With pytest, these lines run all checks:

    @pytest.mark.parametrize("check", OPERATOR_CHECKS)
    def test_contract(check):
        check(MyOperator)
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from random import getstate
from typing import TypeVar
from unittest import SkipTest

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, ViewCounts
from crossgrad_core.training.state import unsavable

C = TypeVar("C", bound=Component)

#: Function that returns a new component with default options.
Make = Callable[[], C]
#: Function that raises `ContractError` if a component breaks the contract, or `SkipTest` if the
#: check does not apply.
Check = Callable[[Make[C]], None]

#: Numbers of views per step that the checks try. Numbers of views that the component does not
#: support are skipped.
VIEW_COUNTS = range(1, 7)


class ContractError(AssertionError):
    """A component has broken its contract. The text of the error describes how."""


def require(holds: object, otherwise: str) -> None:
    """Raise `ContractError(otherwise)` if `holds` is not true.

    In contrast to `assert`, this function also works with `python -O`.
    """
    if not holds:
        raise ContractError(otherwise)


def cannot_tell(reason: str) -> SkipTest:
    """Return the exception for a check that does not apply.

    With this exception, pytest reports a skipped check.
    """
    return SkipTest(reason)


def admitted(views: ViewCounts) -> tuple[int, ...]:
    """Return the numbers of views per step that the checks try.

    Raises:
        ContractError: The component supports no number in `VIEW_COUNTS`.
    """
    counts = tuple(count for count in VIEW_COUNTS if views.admits(count))
    require(
        counts, f"the component supports no number of views from 1 to {max(VIEW_COUNTS)}: {views}"
    )
    return counts


def revived(state: PluginState) -> PluginState:
    """Return the state after a simulated checkpoint.

    Values are converted to JSON and back, and tensors are copied.

    Raises:
        ContractError: The values cannot be stored as JSON.
    """
    try:
        values = json.loads(json.dumps(dict(state.values), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ContractError(
            f"the state cannot be stored as JSON ({error}): keep plain numbers, strings, "
            "lists and dictionaries with string keys in `values`, and tensors in "
            "`tensors`"
        ) from error
    wrong = unsavable(state, "cpu")
    require(not wrong, f"a checkpoint cannot hold the state: {wrong}")
    return PluginState(values, _cloned(state.tensors), _cloned(state.per_primitive))


def same_state(one: PluginState, other: PluginState) -> bool:
    """Return True if two states have equal values and bit-identical tensors."""
    return (
        dict(one.values) == dict(other.values)
        and _same_tensors(one.tensors, other.tensors)
        and _same_tensors(one.per_primitive, other.per_primitive)
    )


@contextmanager
def global_randomness_untouched() -> Iterator[None]:
    """Raise `ContractError` if code in the block uses a global random number generator."""
    before = _global_states()
    yield
    for name, state in _global_states().items():
        require(
            state == before[name],
            f"the component draws from the global generator of {name}; every random number must "
            "come from the generator that it is given",
        )


def _global_states() -> dict[str, object]:
    algorithm, keys, *rest = np.random.get_state()  # noqa: NPY002 - only the state of the generator is read
    return {
        "numpy": (algorithm, np.asarray(keys).tobytes(), tuple(rest)),
        "torch": torch.get_rng_state().numpy().tobytes(),
        "random": getstate(),
    }


def _cloned(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def _same_tensors(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(
        torch.equal(tensor, other[name]) for name, tensor in one.items()
    )
