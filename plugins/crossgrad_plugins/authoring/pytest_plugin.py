"""`pytest --crossgrad-matrix PACKAGE`: the combinations of a package as tests.

pytest imports this module in every run of an environment with crossgrad. To keep this import fast,
other modules are imported only if the option is given.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

if TYPE_CHECKING:
    from crossgrad_core.commands import RunConfig

#: Prefix of the test names: `crossgrad-matrix::sampler=... operator=...`.
NAME = "crossgrad-matrix"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("crossgrad")
    group.addoption(
        "--crossgrad-matrix",
        metavar="PACKAGE",
        help="also train the components of an installed package together with all other "
        "components (pairwise)",
    )
    group.addoption(
        "--crossgrad-matrix-full",
        action="store_true",
        help="with --crossgrad-matrix: all combinations instead of a pairwise design",
    )


def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Add a test for each combination."""
    package = session.config.getoption("crossgrad_matrix")
    if package is not None:
        matrix = Matrix.from_parent(session, name=NAME, nodeid=NAME, package=package)
        items += matrix.collect()


class Matrix(pytest.Collector):
    """The combinations of one package."""

    def __init__(self, *, package: str, **kwargs: Any) -> None:  # noqa: ANN401 - pytest's own
        super().__init__(**kwargs)
        self.package = package

    @override
    def collect(self) -> list[pytest.Item]:
        """Return a test for each combination, including refused combinations.

        Raises:
            UsageError: There is no such package, or none of its components can be combined.
        """
        from crossgrad_core.commands import UserError

        try:
            return list(self._items())
        except UserError as error:
            raise pytest.UsageError(str(error)) from error

    def _items(self) -> Iterator[pytest.Item]:
        from crossgrad_plugins.authoring.matrix.combinations import config_of, named
        from crossgrad_plugins.authoring.matrix.members import combinations_of, members_of
        from crossgrad_plugins.authoring.matrix.report import Tally

        tally = Tally(members_of(self.package))
        full = self.config.getoption("crossgrad_matrix_full")
        for design in combinations_of(tally.members, tally.admits, full=full):
            for row in design.rows:
                name = named(row, design.slots)
                if not full or tally.admits(row, design.slots):
                    make = partial(config_of, row, design.slots)
                    yield Combination.from_parent(self, name=name, make=make, reasons=())
        for slots, rows in tally.refused.items():
            for row, reasons in rows.items():
                name = named(row, slots)
                yield Combination.from_parent(self, name=name, make=None, reasons=reasons)


class Combination(pytest.Item):
    """A test of one combination; a refused combination is skipped with the reasons."""

    def __init__(
        self,
        *,
        make: "Callable[[], RunConfig] | None",
        reasons: tuple[str, ...],
        **kwargs: Any,  # noqa: ANN401 - pytest's own
    ) -> None:
        super().__init__(**kwargs)
        self.make, self.reasons = make, reasons

    @override
    def runtest(self) -> None:
        """Train the combination."""
        from crossgrad_core.testing.support.short_runs import try_out
        from crossgrad_plugins.authoring.matrix.combinations import STEPS

        if self.make is None:
            pytest.skip("refused before training: " + "; ".join(self.reasons))
        try_out(self.make(), STEPS)

    @override
    def reportinfo(self) -> tuple[str, None, str]:
        """Return the location that pytest reports, because the test has no source file."""
        return NAME, None, self.name
