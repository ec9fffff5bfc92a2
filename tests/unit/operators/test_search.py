"""The search for the worst gradients finds what it should, and finds it again."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from crossgrad_core.contract.gramian_operator import GramianOperator
from crossgrad_core.errors import UserError
from crossgrad_operators.projection import Symmetric
from crossgrad_operators.stress.promises import PROMISES
from crossgrad_operators.stress.reference import ORACLES
from crossgrad_operators.stress.search.examine import examine
from crossgrad_operators.stress.search.families import FAMILIES, Batch, results, rounded
from crossgrad_operators.stress.search.finite import as_text, run_finite
from crossgrad_operators.stress.search.loop import Extent, fresh, search, shrunk
from crossgrad_operators.stress.search.repeat import read_rows
from crossgrad_operators.stress.search.report import failed
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.suite import Subject, reference_of, subject_of

BOTH = (torch.float32, torch.float64)


def symmetric_as(operator):
    """An operator that claims to be `symmetric`."""
    return Subject("flawed", operator, reference_of("symmetric", Symmetric()))


def one_in(count, gramians):
    """[B] a fixed choice of one Gramian in so many."""
    mantissa, _ = np.frexp(gramians.sum(axis=(1, 2)))
    return np.floor(np.abs(mantissa) * 2.0**40) % count == 0


class SeldomOff(Symmetric):
    """Wrong by 1e-5 on one case in fifty."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        wrong = one_in(50, gramians)[:, None, None]
        return matrices * np.where(wrong, 1 + 1e-5, 1.0), state


class Off(Symmetric):
    """Wrong by 1e-5 on every case."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        return matrices * (1 + 1e-5), state


class SeldomNan(Symmetric):
    """Not a number on one case in ten thousand."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        wrong = one_in(10_000, gramians)[:, None, None]
        return np.where(wrong, np.nan, matrices), state


class Jumps(Symmetric):
    """The sum or nothing, depending on digits that no answer depends on."""

    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        return matrices * (gramians[:, :1, :1] * 2.0**52 % 2 < 1), state


class Absolute(GramianOperator):
    """Compares lengths with a constant."""

    def transform(self, gramians, context, state, rng):
        long = np.einsum("bkk->bk", gramians) > 1
        return np.eye(gramians.shape[1]) * np.where(long, 1.0, 2.0)[:, :, None], state


@pytest.mark.parametrize("dtype", BOTH, ids=str)
def test_the_operator_search_finds_an_operator_that_is_seldom_slightly_wrong(dtype):
    (tally,) = search([symmetric_as(SeldomOff())], Extent(rounds=4, dtypes=(dtype,)))
    assert failed(tally)
    assert "u kappa" in tally.failures[0][1]


def test_the_operator_search_finds_an_operator_that_rarely_returns_nan():
    found = run_finite(symmetric_as(SeldomNan()), 20_000)
    assert found.not_finite > 0
    assert "not finite" in as_text([found])
    rows = found.example.rows
    again = results(SeldomNan(), Batch(rows[None], found.example.dtype, "again"))
    assert np.isnan(again).any()


def test_the_operator_search_finds_an_operator_with_a_discontinuity():
    (tally,) = search([symmetric_as(Jumps())], Extent(rounds=1, dtypes=(torch.float64,)))
    assert any("moves by" in reason for _, reason in tally.failures)


def test_an_operator_without_a_reference_must_scale_with_the_gradients():
    theirs = Subject("theirs", Absolute(), reference_of("theirs", Absolute()))
    (tally,) = search([theirs], Extent(rounds=2, dtypes=BOTH[:1]))
    assert failed(tally)


def test_the_correct_operator_passes_the_operator_search():
    assert not any(map(failed, search([symmetric_as(Symmetric())], Extent(rounds=8))))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("rounds", [4, pytest.param(16, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [*sorted(ORACLES), "chain"])
def test_a_short_search_finds_no_result_outside_the_stated_bounds(name, rounds):
    (tally, wide) = search([subject_of(name)], Extent(seed=1, rounds=rounds))
    assert not tally.failures and not wide.failures


def test_the_stated_bounds_are_documented():
    page = (Path(__file__).parents[3] / "docs" / "operators.md").read_text(encoding="utf-8")
    for name, promise in PROMISES.items():
        assert f"| {name} | " in page and f" | {promise.factor_words} |" in page


@pytest.mark.slow
def test_a_longer_search_begins_with_the_cases_of_a_shorter_search():
    once = search([symmetric_as(SeldomOff())], Extent(rounds=3, seed=5))
    again = search([symmetric_as(SeldomOff())], Extent(rounds=3, seed=5))
    for one, other in zip(once, again, strict=True):
        assert (one.matrices, one.broken) == (other.matrices, other.broken)
        pairs = zip(one.pool, other.pool, strict=True)
        assert all(np.array_equal(a.rows, b.rows) for a, b in pairs)
    assert not np.array_equal(fresh(Extent(seed=5), 2).rows, fresh(Extent(seed=6), 2).rows)


@pytest.mark.parametrize("dtype", BOTH, ids=str)
@pytest.mark.parametrize("family", list(FAMILIES))
def test_sampled_gradients_are_finite_and_exact_in_their_type(family, dtype):
    rows = rounded(FAMILIES[family](np.random.default_rng(1), 50, 7, 5), dtype)
    assert rows.shape == (50, 7, 5)
    assert np.isfinite(rows).all()
    assert np.array_equal(torch.from_numpy(rows).to(dtype).double().numpy(), rows)


def test_gradient_families_reach_their_intended_extremes():
    rng = np.random.default_rng(2)
    norms = np.linalg.norm(FAMILIES["ratios"](rng, 200, 12, 5), axis=2)
    assert (norms.max(axis=1) / norms.min(axis=1)).max() > 1e11
    assert (np.linalg.matrix_rank(FAMILIES["low rank"](rng, 50, 9, 9)) <= 3).all()
    copies = FAMILIES["near copies"](rng, 400, 2, 5)
    unit = copies / np.linalg.norm(copies, axis=2, keepdims=True)
    apart = np.linalg.norm(unit[:, 0] - unit[:, 1], axis=1)
    assert {int(np.log10(d)) for d in apart if 0 < d < 1} >= set(range(-14, 0))
    assert (~FAMILIES["zeros"](rng, 50, 6, 5).any(axis=2)).any()


def test_a_failing_case_is_reduced_to_the_gradients_that_cause_it():
    class OffForThree(Symmetric):
        def transform(self, gramians, context, state, rng):
            matrices, state = super().transform(gramians, context, state, rng)
            return matrices * (1 + 1e-4 * (gramians.shape[1] >= 3)), state

    subject = symmetric_as(OffForThree())
    rows = rounded(np.random.default_rng(4).standard_normal((6, 7)), torch.float32)
    value = examine(subject, Batch(rows[None], torch.float32, "test"))[0].error
    small = shrunk(subject, Sample(rows, torch.float32, "test", 0, value), inside=True)
    assert len(small.rows) == 3
    assert small.rows.shape[1] <= 2


def test_printed_gradients_are_read_back_exactly():
    for dtype in BOTH:
        rows = rounded(FAMILIES["mixed"](np.random.default_rng(5), 1, 4, 3)[0], dtype)
        text = Sample(rows, dtype, "test", 0, 1.0).text()
        assert np.array_equal(read_rows(text, dtype).exact_head, rows)


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "1",
            "[1,2]",
            "[[1,2],[3]]",
            "[[1,a]]",
            "[[]]",
            "[[NaN,1]]",
            "[[1e999,1]]",
            "[[1e39,1]]",
        ),
        *("[" * 5000, f"[[1{'0' * 400},1]]"),
    ],
)
def test_gradients_that_do_not_form_a_matrix_are_refused(text):
    with pytest.raises(UserError, match="not a matrix"):
        read_rows(text, torch.float32)


def stress(*arguments):
    from crossgrad_core.cli.main import app

    return CliRunner().invoke(app, ["stress", *arguments])


def test_the_command_searches_and_repeats_a_printed_case():
    found = stress("symmetric", "--search", "0.01", "--type", "float32")
    assert found.exit_code == 0, found.output
    assert "no broken guarantee" in found.output
    rows = found.output.split("--rows '", 1)[1].split("'", 1)[0]
    assert len(json.loads(rows)) >= 2
    assert stress("symmetric", "--rows", rows, "--type", "float32").exit_code == 0


def test_a_failed_search_ends_with_exit_code_1(monkeypatch):
    from crossgrad_operators.stress import suite

    monkeypatch.setattr(suite, "subject_of", lambda _name: symmetric_as(Off()))
    found = stress("symmetric", "--search", "0.01", "--type", "float32")
    assert found.exit_code == 1
    assert "broken guarantees" in found.output


def test_the_command_checks_thousands_of_matrices(monkeypatch):
    assert stress("symmetric", "--matrices", "2500").exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--search", "1", "--rows", "[[1]]"], "--search and --rows cannot be combined"),
        (["--search", "1", "--case", "plain"], "--case has no effect with --search"),
        (["--rows", "[[1]]", "--seed", "1"], "--seed has no effect with --rows"),
        (["--type", "float32"], "--type has no effect with the fixed cases"),
    ],
)
def test_options_without_an_effect_are_refused(arguments, message):
    found = stress(*arguments)
    assert isinstance(found.exception, UserError)
    assert message in str(found.exception)


def test_every_kind_of_search_writes_a_table(tmp_path):
    for place, mode in enumerate((["--search", "0.01"], ["--matrices", "10"], ["--rows", "[[1]]"])):
        path = tmp_path / f"{place}.csv"
        assert stress("sum", *mode, "--csv", str(path)).exit_code == 0
        assert path.read_text().startswith("operator,")
