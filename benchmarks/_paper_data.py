"""Claims of the paper with what tests them, its tables, and the plan of `make paper`, as data."""

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

HERE = Path(__file__).parent
DATA = HERE / "paper_data"
#: How many methods are run on each of the other backbones, and compared there.
BEST = 2
#: Grids as they stand in the repository.
GRIDS = HERE / "grids" / "paper"

#: How the first of two compares with the second.
Expected: TypeAlias = Literal["better", "worse", "equal", "not better"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Pairing(_Part):
    """Two arms whose held-out figures are compared.

    Attributes:
        first: Name of an arm.
        second: Name of another one.
        scenes: The only scenes that count; empty for all that both have.
    """

    first: str
    second: str
    scenes: tuple[str, ...] = ()


class Reading(_Part):
    """A figure of diagnostics.csv, averaged over the probes of a run.

    Attributes:
        column: Its column.
        block: Its block; `each` averages over single blocks, too.
        metric: In which metric gradients are measured.
    """

    column: str
    block: str
    metric: Literal["plain", "adam"] = "plain"


class Probe(_Part):
    """A figure of the gradients of an arm's runs, alone or against another one of the same runs.

    Attributes:
        arm: Name of the arm, which has the observer `diagnostics`.
        first: The figure.
        second: What is taken away from it; None for nothing.
        scenes: The only scenes that count; empty for all.
    """

    arm: str
    first: Reading
    second: Reading | None = None
    scenes: tuple[str, ...] = ()


class Arithmetic(_Part):
    """A statement about figures of the paper's own tables: shares of a gap within bounds.

    Attributes:
        table: Table of `method` and `base`.
        method: The row that closes the gap.
        base: The row from which the gap is counted.
        target_table: Table of `target`.
        target: The row up to which it is counted.
        low: The least share.
        high: The largest share.
        scenes: On how many scenes that holds.
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
    """Test of a statement: exactly one of four kinds.

    Attributes:
        test: Two arms.
        probe: A figure of the gradients.
        arithmetic: The paper's own figures.
        none: Why nothing tests it.
        expected: What the statement says of `test`, or of the sign of `probe`.
        within: What it says of the value of `probe`.
        margin: What counts as no difference; None for 0.1 dB.
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
        """The arms whose runs it needs."""
        if self.test is not None:
            return self.test.first, self.test.second
        return () if self.probe is None else (self.probe.arm,)


class Claim(Check):
    """A statement of the paper's text.

    Attributes:
        id: A short name, unique.
        where: Where it stands.
        says: What it says.
    """

    id: str
    where: str
    says: str


class Row(_Part):
    """Test of a row of a table.

    Attributes:
        first: The arm that stands for the row.
        second: The arm that stands for the reference; with `first` only.
        probe: A figure of the gradients instead.
        none: Why nothing tests it.
        expected: What the row says of the sign of `probe`.
        margin: What counts as no difference of `probe`.
    """

    first: str | None = None
    second: str | None = None
    probe: Probe | None = None
    none: str | None = None
    expected: Expected | None = None
    margin: float | None = None

    def check(self, expected: Expected) -> Check:
        """As a check, where the paper's figures say `expected`."""
        if self.first is not None and self.second is not None:
            return Check(test=Pairing(first=self.first, second=self.second), expected=expected)
        return Check(probe=self.probe, none=self.none, expected=self.expected, margin=self.margin)


class Table(_Part):
    """A table of the paper.

    Attributes:
        id: Its label.
        title: What it is about.
        reference: The method that the others are compared with; None where rows are gains already.
        note: What the reader should know.
        rows: Method -> what tests it.
    """

    id: str
    title: str
    reference: str | None = None
    note: str = ""
    rows: dict[str, Row]


class Section(_Part):
    """Claims that are judged together."""

    title: str
    claims: tuple[Claim, ...]


class Claims(_Part):
    """Everything that the paper says.

    Attributes:
        source: The paper.
        untestable: Why figures on the paper's scenes are not tested.
        recipes: Scenes of the paper -> what those who have them can do.
        tables: Its tables.
        sections: Claims of its text.
    """

    source: str
    untestable: str
    recipes: dict[str, str]
    tables: tuple[Table, ...]
    sections: tuple[Section, ...]

    def checks(self) -> Iterator[Check]:
        """Everything that is tested."""
        for table in self.tables:
            yield from (row.check("better") for row in table.rows.values())
        for section in self.sections:
            yield from section.claims


class BestOf(_Part):
    """A grid whose arms are run with the best of other grids' methods.

    Attributes:
        grid: The grid.
        candidates: Arms that they are chosen from.
        scaffold_like: Backbone -> the tuned arms whose rates it takes, with one view and with more.
    """

    grid: str
    candidates: tuple[str, ...]
    scaffold_like: dict[str, dict[Literal["one", "more"], str]] = Field(default_factory=dict)


class Plan(_Part):
    """The order and the rates of `make paper`.

    Attributes:
        tuning: The grid that factors of rates are read off.
        grids: The grids that are measured, in their order.
        rates: Arm -> the tuned arm whose factors it takes; `default` for the rest.
        fixed_rates: Grids whose arms set their own.
        best_of: The grid that depends on the others' results.
    """

    tuning: str
    grids: tuple[str, ...]
    rates: dict[str, str]
    fixed_rates: tuple[str, ...]
    best_of: BestOf


@dataclass(frozen=True)
class Figure:
    """A figure of the paper."""

    scene: str
    metric: str
    value: float | None


#: Table -> method -> its figures, in the order of the paper.
Tables: TypeAlias = Mapping[str, Mapping[str, list[Figure]]]


def read_claims() -> Claims:
    """The paper's claims."""
    text = (DATA / "claims.yaml").read_text(encoding="utf-8")
    return Claims.model_validate(yaml.safe_load(text))


def read_plan() -> Plan:
    """The plan of `make paper`."""
    text = (DATA / "plan.yaml").read_text(encoding="utf-8")
    return Plan.model_validate(yaml.safe_load(text))


def read_tables() -> Tables:
    """The figures of the paper's tables."""
    found: dict[str, dict[str, list[Figure]]] = {}
    with (DATA / "tables.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            value = float(row["value"]) if row["value"] else None
            figures = found.setdefault(row["table"], {}).setdefault(row["method"], [])
            figures.append(Figure(row["scene"], row["metric"], value))
    return found


def values(tables: Tables, table: str, method: str, metric: str) -> dict[str, float]:
    """Scene -> the value of a method; scenes without one are left out."""
    return {
        figure.scene: figure.value
        for figure in tables[table][method]
        if figure.metric == metric and figure.value is not None
    }
