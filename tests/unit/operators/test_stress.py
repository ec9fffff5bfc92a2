"""The stability suite holds, and notices what does not."""

from math import isnan

import mpmath
import numpy as np
import pytest
import torch
from support.commands import ended
from typer.testing import CliRunner

from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries
from crossgrad_operators.projection import Symmetric
from crossgrad_operators.stress.cases import Case, cases, short
from crossgrad_operators.stress.runner import Reference, run_case
from crossgrad_operators.stress.suite import (
    as_text,
    failed,
    made,
    reference_of,
    run_suite,
    write_csv,
)
from crossgrad_operators.stress.verdict import ExactCase

OURS = sorted(n for n, e in entries("operators").items() if e.value.startswith("crossgrad_"))
#: The same cases with shorter gradients.
SHORT = cases(large=20_000, exact=300)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("case", SHORT, ids=lambda case: case.name)
def test_every_operator_passes_every_stress_case(case):
    with mpmath.mp.workdps(50):
        exact = ExactCase(case)
        for name in OURS:
            operator = made(name)
            cell = run_case(name, operator, exact, reference_of(name, operator))
            assert cell.finding.verdict != "failed", (name, cell.finding)


def test_every_bundled_operator_except_the_adapter_has_a_reference():
    for name in OURS:
        reference = reference_of(name, made(name))
        assert (reference.oracle or reference.rule) or name == "torchjd"


class Careless(Symmetric):
    """Off by one part in a million."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        return matrices * (1 + 2e-6), state


class Broken(Symmetric):
    """Divides by the smallest norm."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        with np.errstate(all="ignore"):
            return matrices / np.einsum("bkk->bk", gramians).min(), state


@pytest.mark.parametrize(
    ("operator", "case", "reason"),
    [
        (Careless(), "conflict", "u kappa"),
        (Careless(), "ratio 1e12", "u kappa"),
        (Broken(), "zero row", "not finite"),
    ],
)
def test_deliberate_flaws_are_found(operator, case, reason):
    (chosen,) = (c for c in SHORT if c.name == case)
    reference = Reference(reference_of("symmetric", Symmetric()).oracle, {})
    with mpmath.mp.workdps(50):
        finding = run_case("flawed", operator, ExactCase(chosen), reference).finding
    assert finding.verdict == "failed"
    assert reason in finding.reason


def test_an_operator_without_a_reference_must_be_finite():
    case = short("plain", [[1.0, 2.0], [2.0, 1.0]])
    with mpmath.mp.workdps(50):
        cell = run_case("theirs", Symmetric(), ExactCase(case), Reference(None, {}))
    assert cell.finding.verdict == "ok"
    assert isnan(cell.finding.error)


def test_exact_gramians_have_fifty_digits():
    """Test 1e8 + 1 - 1e8 in float32 products, and 2^-149 squared."""
    tiny = 2.0**-149
    case = short("tiny", [[1e8, 1.0, tiny], [1e8, -1.0, tiny]])
    with mpmath.mp.workdps(50):
        gramian = ExactCase(case).gramian
        assert gramian[0][1] == mpmath.mpf(10) ** 16 - 1 + mpmath.mpf(2) ** -298


def test_a_repeated_pattern_counts_with_its_repetitions():
    case = Case("x", np.zeros((2, 0)), np.array([[1.0, 2.0], [3.0, -1.0]]), copies=7)
    assert case.size == 14
    assert torch.cat([g[:2] for g in case.gradients()]).tolist() == [1, 2, 3, -1]
    with mpmath.mp.workdps(50):
        assert ExactCase(case).gramian == [[35, 7], [7, 70]]


def test_the_table_shows_errors_times_and_failures(tmp_path):
    chosen = [c for c in SHORT if c.name in {"plain", "K = 3"}]
    cells = list(run_suite(["symmetric", "anchors"], chosen))
    text = as_text(cells)
    assert "all " in text and "checks hold" in text
    assert not failed(cells)
    write_csv(cells, tmp_path / "table.csv")
    rows = (tmp_path / "table.csv").read_text().splitlines()
    assert len(rows) == 1 + len(cells)
    assert any(row.startswith("anchors,K = 3,refused") for row in rows)


def test_an_existing_table_is_not_overwritten(tmp_path, capsys):
    table = tmp_path / "table.csv"
    table.write_text("mine")
    assert ended("stress", "symmetric", "--case", "plain", "--csv", table) == 2
    assert (
        "the output file already exists" in capsys.readouterr().err and table.read_text() == "mine"
    )


def test_an_unknown_stress_case_is_refused(capsys):
    assert ended("stress", "symmetric", "--case", "nosuch", "--elements", "1000") == 2
    assert "no case name contains this text" in capsys.readouterr().err


def test_the_exit_code_tells_whether_checks_fail(monkeypatch):
    from crossgrad_core.cli.main import app
    from crossgrad_operators.stress import suite

    arguments = ["stress", "symmetric", "--case", "conflict", "--elements", "1000"]
    good = CliRunner().invoke(app, arguments)
    assert good.exit_code == 0, good.output
    monkeypatch.setattr(suite, "made", lambda name: Careless())
    bad = CliRunner().invoke(app, arguments)
    assert bad.exit_code == 1
    assert "checks fail" in bad.output


def test_the_suite_without_mpmath_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mpmath", None)
    with pytest.raises(UserError, match=r"crossgrad\[test\]"):
        list(run_suite(["sum"], []))
