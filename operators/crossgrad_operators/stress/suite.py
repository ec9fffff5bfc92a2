"""The whole suite: every operator on every case, and every law."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from crossgrad_core.commands import build
from crossgrad_core.commands import names as installed_names
from crossgrad_core.plugin import Operator
from crossgrad_operators.stress.case import Case
from crossgrad_operators.stress.exact import DIGITS, require_mpmath
from crossgrad_operators.stress.invariances import LAWS, run_law
from crossgrad_operators.stress.promises import Promise, promise_of
from crossgrad_operators.stress.reference import OPTIONS, ORACLES, chained
from crossgrad_operators.stress.runner import Cell, Reference, run_case
from crossgrad_operators.stress.verdict import ExactCase, one_sign


def installed() -> list[str]:
    """Names of all operators, third parties' too."""
    return installed_names("operators")


def made(name: str) -> Operator:
    """An operator with the options under which the suite runs it."""
    return build(Operator, name, OPTIONS.get(name, {}))


@dataclass(frozen=True, eq=False)
class Subject:
    """An operator with everything that it is compared with.

    Attributes:
        name: Name of the operator.
        operator: The operator.
        reference: Its 50-digit oracle or its rule for elements, where it has one.
    """

    name: str
    operator: Operator
    reference: Reference

    @property
    def promise(self) -> Promise:
        """The promise of the operator."""
        return self.reference.promise


def subject_of(name: str) -> Subject:
    """The installed operator of a name, with the references of a built-in if it is one.

    Raises:
        UserError: The operator does not exist or cannot be made.
    """
    operator = made(name)
    return Subject(name, operator, reference_of(name, operator))


def run_suite(
    names: Sequence[str], cases: Sequence[Case], progress: Callable[[str], None] = lambda _: None
) -> Iterator[Cell]:
    """Cells of all operators for one case after the other, then the laws.

    Raises:
        UserError: mpmath is not installed, or an operator cannot be made.
    """
    mpmath = require_mpmath()
    subjects = [subject_of(name) for name in names]
    with mpmath.mp.workdps(DIGITS):
        for case in cases:
            progress(case.name)
            exact = ExactCase(case)
            for each in subjects:
                yield run_case(each.name, each.operator, exact, each.reference)
        for law in LAWS:
            progress(law.__name__)
            yield from (run_law(each.name, each.operator, law) for each in subjects)


def reference_of(name: str, operator: Operator) -> Reference:
    """What a built-in operator is held against; a third party's of the same name has nothing."""
    options: dict[str, Any] = {
        field: getattr(operator, field) for field in type(operator).model_fields
    }
    if not type(operator).__module__.startswith("crossgrad_operators."):
        return Reference(None, options)
    if name == "graddrop":
        return Reference(None, options, one_sign, promise_of(name))
    oracle = chained if name == "chain" else ORACLES.get(name)
    return Reference(oracle, options, promise=promise_of(name))
