"""The paper's claims and tables with their tests, and the plan of `make paper`, as data."""

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

HERE = Path(__file__).parent
DATA = HERE / "paper_data"
#: Number of methods that are also compared on each of the other backbones.
BEST = 2
#: Folder of the grids that are stored in the repository.
GRIDS = HERE / "grids" / "paper"

#: Expected relation of the first arm to the second arm.
Expected: TypeAlias = Literal["better", "worse", "equal", "not better"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Pairing(_Part):
    """Two arms whose held-out metrics are compared.

    Attributes:
        first: Name of an arm.
        second: Name of another arm.
        scenes: Scenes that count; empty for all scenes that both arms have.
    """

    first: str
    second: str
    scenes: tuple[str, ...] = ()


class Reading(_Part):
    """A column of diagnostics.csv, averaged over the probes of a run.

    Attributes:
        column: Column of the table.
        block: Block of the gradients; `each` averages over all single blocks.
        metric: Metric in which gradients are measured.
    """

    column: str
    block: str
    metric: Literal["plain", "adam"] = "plain"


class Probe(_Part):
    """A statistic of the gradients in an arm's runs, or the difference of two such statistics.

    Attributes:
        arm: Name of the arm, which uses the observer `diagnostics`.
        first: The statistic.
        second: The statistic that is subtracted, or None.
        scenes: Scenes that count; empty for all.
    """

    arm: str
    first: Reading
    second: Reading | None = None
    scenes: tuple[str, ...] = ()


class Arithmetic(_Part):
    """A statement about the paper's own numbers: a method closes a certain share of a gap.

    Attributes:
        table: Table with the rows `method` and `base`.
        method: The row that closes the gap.
        base: The row at which the gap starts.
        target_table: Table with the row `target`.
        target: The row at which the gap ends.
        low: Lower bound of the share.
        high: Upper bound of the share.
        scenes: Number of scenes for which the statement must be true.
    """

    table: str
    method: str
    base: str
    target_table: str
    target: str
    low: float
    high: float
    scenes: int


class Check(_Part):
    """The test of a statement; exactly one of its first four fields is set.

    Attributes:
        test: The two arms that are compared.
        probe: A statistic of the gradients.
        arithmetic: A statement about the paper's own numbers.
        none: Reason why the statement is not tested.
        expected: The expected relation of the two arms in `test`, or the expected sign of `probe`.
        within: The expected bounds of `probe`.
        margin: Largest difference that counts as equal, or None for 0.1 dB.
    """

    test: Pairing | None = None
    probe: Probe | None = None
    arithmetic: Arithmetic | None = None
    none: str | None = None
    expected: Expected | None = None
    within: tuple[float, float] | None = None
    margin: float | None = None

    @model_validator(mode="after")
    def _is_one_kind(self) -> "Check":
        kinds = [self.test, self.probe, self.arithmetic, self.none]
        if sum(each is not None for each in kinds) != 1:
            raise ValueError("must have exactly one of test, probe, arithmetic and none")
        if self.test is not None and (self.expected is None or self.within is not None):
            raise ValueError("a test of two arms needs `expected`")
        if self.probe is not None and (self.expected is None) == (self.within is None):
            raise ValueError("a probe needs one of `expected` and `within`")
        return self

    @property
    def arms(self) -> tuple[str, ...]:
        """The arms whose runs are needed for the test."""
        if self.test is not None:
            return self.test.first, self.test.second
        return () if self.probe is None else (self.probe.arm,)


class Claim(Check):
    """A statement of the paper's text.

    Attributes:
        id: A unique short name.
        where: Section or table of the paper with the statement.
        says: Text of the statement.
    """

    id: str
    where: str
    says: str


class Row(_Part):
    """The test of one row of a table.

    Attributes:
        first: The arm that represents the row.
        second: The arm that represents the reference; only used together with `first`.
        probe: A statistic of the gradients that is tested instead of two arms.
        none: Reason why the row is not tested.
        expected: The expected sign of `probe`, as in the row.
        margin: Largest difference of `probe` that counts as equal.
    """

    first: str | None = None
    second: str | None = None
    probe: Probe | None = None
    none: str | None = None
    expected: Expected | None = None
    margin: float | None = None

    def check(self, expected: Expected) -> Check:
        """Return the row as a check; `expected` is the relation in the paper's numbers."""
        if self.first is not None and self.second is not None:
            return Check(test=Pairing(first=self.first, second=self.second), expected=expected)
        return Check(probe=self.probe, none=self.none, expected=self.expected, margin=self.margin)


class Table(_Part):
    """A table of the paper.

    Attributes:
        id: Label of the table.
        title: Topic of the table.
        reference: The method with which rows are compared; None if the rows already are gains.
        note: Remarks for readers.
        rows: Method -> its test.
    """

    id: str
    title: str
    reference: str | None = None
    note: str = ""
    rows: dict[str, Row]


class Section(_Part):
    """Claims whose p-values are corrected together."""

    title: str
    claims: tuple[Claim, ...]


class Claims(_Part):
    """All claims of the paper.

    Attributes:
        source: The paper's title and address.
        untestable: Reason why values on the paper's scenes are not tested.
        recipes: Scenes of the paper -> instructions for readers who have these scenes.
        tables: Tables of the paper.
        sections: Claims of the paper's text.
    """

    source: str
    untestable: str
    recipes: dict[str, str]
    tables: tuple[Table, ...]
    sections: tuple[Section, ...]

    def checks(self) -> Iterator[Check]:
        """Yield the checks of all tables and sections."""
        for table in self.tables:
            yield from (row.check("better") for row in table.rows.values())
        for section in self.sections:
            yield from section.claims


class BestOf(_Part):
    """A grid whose arms use the best methods of other grids.

    Attributes:
        grid: The grid.
        candidates: Arms from which the best methods are chosen.
        scaffold_like: Backbone -> tuned arms whose learning rates this backbone uses, for one view
            and for several views.
    """

    grid: str
    candidates: tuple[str, ...]
    scaffold_like: dict[str, dict[Literal["one", "more"], str]] = Field(default_factory=dict)


class Plan(_Part):
    """The order and the learning rates of `make paper`.

    Attributes:
        tuning: The grid that gives the factors of the learning rates.
        grids: The measured grids, in order.
        rates: Arm -> the tuned arm whose learning-rate factors it uses. The key `default` applies
            to all other arms.
        fixed_rates: Grids whose arms already contain learning rates.
        best_of: The grid that depends on the results of the other grids.
    """

    tuning: str
    grids: tuple[str, ...]
    rates: dict[str, str]
    fixed_rates: tuple[str, ...]
    best_of: BestOf


@dataclass(frozen=True)
class Figure:
    """A number in the paper, for a scene and a metric."""

    scene: str
    metric: str
    value: float | None


#: Table -> method -> its numbers, in the order of the paper.
Tables: TypeAlias = Mapping[str, Mapping[str, list[Figure]]]


def read_claims() -> Claims:
    """Return the paper's claims."""
    text = (DATA / "claims.yaml").read_text(encoding="utf-8")
    return Claims.model_validate(yaml.safe_load(text))


def read_plan() -> Plan:
    """Return the plan of `make paper`."""
    text = (DATA / "plan.yaml").read_text(encoding="utf-8")
    return Plan.model_validate(yaml.safe_load(text))


def read_tables() -> Tables:
    """Return the numbers of the paper's tables."""
    found: dict[str, dict[str, list[Figure]]] = {}
    with (DATA / "tables.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            value = float(row["value"]) if row["value"] else None
            figures = found.setdefault(row["table"], {}).setdefault(row["method"], [])
            figures.append(Figure(row["scene"], row["metric"], value))
    return found


def values(tables: Tables, table: str, method: str, metric: str) -> dict[str, float]:
    """Return the number of a method for each scene that has one."""
    return {
        figure.scene: figure.value
        for figure in tables[table][method]
        if figure.metric == metric and figure.value is not None
    }
