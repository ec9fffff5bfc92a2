"""An operator as the search sees it."""

from collections.abc import Iterable
from dataclasses import dataclass

from crossgrad_core.plugin import Operator
from crossgrad_operators.stress.promises import Promise
from crossgrad_operators.stress.runner import Reference
from crossgrad_operators.stress.search.quick import QUICK, Quick
from crossgrad_operators.stress.suite import made, reference_of


@dataclass(frozen=True, eq=False)
class Subject:
    """An operator with everything that it is held against.

    Attributes:
        name: Name of the operator.
        operator: The operator, with the options of the stability suite.
        reference: Its 50-digit oracle or its rule for elements, where it has one.
        quick: The same answers in 32 digits for many cases at once, where it has them.
    """

    name: str
    operator: Operator
    reference: Reference
    quick: Quick | None

    @property
    def promise(self) -> Promise:
        """What is promised of it."""
        return self.reference.promise


def subjects(names: Iterable[str]) -> list[Subject]:
    """The operators of these names.

    Raises:
        UserError: An operator does not exist or cannot be made.
    """
    return [subject_of(name, made(name)) for name in names]


def subject_of(name: str, operator: Operator) -> Subject:
    """An operator under a name: with the references of the built-in of that name, if it is that."""
    reference = reference_of(name, operator)
    quick = QUICK.get(name) if reference.oracle is not None else None
    return Subject(name, operator, reference, quick)
