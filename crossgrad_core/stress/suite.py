"""The whole suite: every operator on every case, and every law."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

from crossgrad_core.operator import Operator
from crossgrad_core.registry import build, entries
from crossgrad_core.stress.case import Case
from crossgrad_core.stress.exact import DIGITS, require_mpmath
from crossgrad_core.stress.invariances import LAWS, judge_law
from crossgrad_core.stress.oracles import Oracle
from crossgrad_core.stress.reference import OPTIONS, ORACLES, chained
from crossgrad_core.stress.runner import Cell, ExactCase, judge


def installed() -> list[str]:
    """Names of all operators, third parties' too."""
    return list(entries("operators"))


def made(name: str) -> Operator:
    """An operator with the options under which the suite runs it."""
    return cast("Operator", build("operators", name, OPTIONS.get(name, {})))


def run_suite(
    names: Sequence[str], cases: Sequence[Case], progress: Callable[[str], None] = lambda _: None
) -> Iterator[Cell]:
    """Cells of all operators for one case after the other, then the laws.

    Raises:
        UserError: mpmath is not installed, or an operator cannot be made.
    """
    mpmath = require_mpmath()
    operators = {name: made(name) for name in names}
    with mpmath.mp.workdps(DIGITS):
        for case in cases:
            progress(case.name)
            exact = ExactCase(case)
            for name, operator in operators.items():
                yield judge(name, operator, exact, oracle_of(name, operator), _options(operator))
        for law in LAWS:
            progress(law.__name__)
            yield from (judge_law(name, operator, law) for name, operator in operators.items())


def oracle_of(name: str, operator: Operator) -> Oracle | None:
    """The oracle of a built-in operator; a third party's of the same name has none."""
    if not type(operator).__module__.startswith("crossgrad_operators."):
        return None
    return chained if name == "chain" else ORACLES.get(name)


def _options(operator: Operator) -> dict[str, Any]:
    return {name: getattr(operator, name) for name in type(operator).model_fields}
