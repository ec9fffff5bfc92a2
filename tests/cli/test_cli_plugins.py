"""`crossgrad plugins`, help texts and exit codes."""

import sys

import pytest
from support.distributions import write_distribution

from crossgrad_core import __version__
from crossgrad_core.cli import main as command
from crossgrad_core.cli.main import main
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import GROUPS

OPERATOR = """
import numpy as np
from pydantic import Field
from crossgrad_core.plugin import GramianOperator, ViewCounts

class Halving(GramianOperator):
    '''Adds half of every gradient.'''

    views = ViewCounts(2, 4)
    share: float = Field(0.5, gt=0, le=1, description="what is left of each gradient")

    def transform(self, gramians, context, state, rng):
        weights = np.where(context.present, self.share, 0.0)
        return weights[:, None, :], state

class Absolute(Halving):
    def transform(self, gramians, context, state, rng):
        weights = 1.0 / np.sqrt(1e-8 + np.einsum("bkk->bk", gramians))
        return np.where(context.present, weights, 0.0)[:, None, :], state
"""


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")


@pytest.fixture
def ran(capsys):
    """Runs a command; gives its exit code and what it printed."""

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        printed = capsys.readouterr()
        return ended.value.code, printed.out, printed.err

    return run


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    operators = {"halving": "made_up_cli:Halving", "absolute": "made_up_cli:Absolute"}
    write_distribution(
        tmp_path / "good", "half-package", {"operators": {"halving": operators["halving"]}}
    )
    write_distribution(
        tmp_path / "bad", "bad-package", {"operators": operators | {"lost": "made_up_lost:A"}}
    )
    (tmp_path / "good" / "made_up_cli.py").write_text(OPERATOR)
    monkeypatch.syspath_prepend(tmp_path / "good")
    yield tmp_path / "bad"
    sys.modules.pop("made_up_cli", None)


def test_version_option_prints_the_version(ran):
    assert ran("--version") == (0, f"crossgrad {__version__}\n", "")


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--help",),
        ("run", "--help"),
        ("eval", "--help"),
        ("render", "-h"),
        ("export", "-h"),
        ("diagnose", "-h"),
        ("stress", "-h"),
        ("plugins", "--help"),
        ("plugins", "list", "-h"),
        ("plugins", "show", "-h"),
        ("plugins", "check", "-h"),
    ],
    ids=" ".join,
)
def test_help_fits_a_terminal_of_80_columns(ran, arguments):
    code, out, err = ran(*arguments)
    assert (code, err) == (0, "")
    assert out.startswith("Usage: crossgrad")
    assert max(map(len, out.splitlines())) <= 80
    assert "..." not in out.partition("Commands:")[2]


def test_help_of_run_is_grouped(ran):
    out = ran("run", "--help")[1]
    titles = ["Arguments:", "Configuration:", "Components", "Training:", "Scene:", "Results:"]
    places = [out.index(title) for title in titles]
    assert places == sorted(places)


@pytest.mark.parametrize("arguments", [("plugins",), ("plugins", "list")], ids=" ".join)
def test_the_list_names_every_plugin_with_its_package(ran, arguments):
    code, out, _ = ran(*arguments)
    assert code == 0
    for slot in GROUPS:
        assert f"\n{slot}\n" in f"\n{out}"
        for entry in registry.offers(slot):
            assert f"  {entry.name} " in out
            assert f"{entry.distribution} {entry.version}" in out


@pytest.mark.parametrize("slot", ["operators", "operator"])
def test_plugins_list_can_be_limited_to_one_slot(ran, slot):
    out = ran("plugins", "list", "--slot", slot)[1]
    assert "symmetric" in out
    assert "samplers" not in out


def test_a_plugin_name_of_two_packages_is_marked_in_the_list(ran, third_party, monkeypatch):
    monkeypatch.syspath_prepend(third_party)
    rows = [row for row in ran("plugins")[1].splitlines() if row.startswith("  halving ")]
    assert len(rows) == 2
    assert all("two packages offer this name" in row for row in rows)


def test_list_and_check_report_an_entry_point_in_an_unknown_group(
    ran, tmp_path, monkeypatch, capsys
):
    lost = {"operator": {"lost": "made_up_cli:Halving"}}
    write_distribution(tmp_path / "site", "lost-package", lost)
    monkeypatch.syspath_prepend(tmp_path / "site")
    out = ran("plugins")[1]
    assert (
        "never read\n  lost  lost-package 1.0: "
        "the entry-point group crossgrad.operator does not exist" in out
    )
    assert "write crossgrad.operators" in out
    code, _, err = ran("plugins", "check", "lost-package")
    assert code == 2 and "the entry-point group crossgrad.operator does not exist" in err


def test_check_fails_for_an_entry_point_in_an_unknown_group(ran, third_party, monkeypatch):
    both = {"operators": {"halving": "made_up_cli:Halving"}, "operator": {"lost": "made_up_cli:A"}}
    write_distribution(third_party, "both-package", both)
    monkeypatch.syspath_prepend(third_party)
    code, out, _ = ran("plugins", "check", "both-package")
    assert (
        code == 1 and "lost  FAIL" in out and "write crossgrad.operators" in " ".join(out.split())
    )


def test_a_package_for_another_version_is_marked_in_the_list(ran, tmp_path, monkeypatch):
    dated = {"operators": {"dated": "made_up_cli:Halving"}}
    write_distribution(tmp_path, "dated-package", dated, requires="crossgrad<0.2")
    monkeypatch.syspath_prepend(tmp_path)
    words = "cannot be chosen: it requires crossgrad<0.2"
    assert f"dated dated-package 1.0 {words}" in " ".join(ran("plugins", "list")[1].split())


def test_an_unknown_slot_is_refused(ran):
    code, out, err = ran("plugins", "list", "--slot", "oprators")
    assert (code, out) == (2, "")
    assert "did you mean 'operators'?" in err


def test_show_prints_options_bounds_docstring_and_package(ran, third_party):
    code, out, _ = ran("plugins", "show", "halving")
    assert code == 0
    for words in (
        "operator halving, from half-package 1.0",
        "made_up_cli:Halving",
        "Adds half of every gradient.",
        "views per step: 2 <= K <= 4",
        "--set operator.OPTION=VALUE",
        "share  (float, default 0.5, > 0, <= 1)",
        "what is left of each gradient",
        "granularity  (block | kind | global | gaussian, default block)",
    ):
        assert words in out


@pytest.mark.sampled(5)
@pytest.mark.parametrize("slot", list(GROUPS))
def test_show_fits_every_bundled_plugin_into_80_columns(ran, slot):
    for entry in registry.offers(slot):
        if entry.distribution == "crossgrad":
            code, out, err = ran("plugins", "show", entry.name, "--slot", slot)
            assert (code, err) == (0, ""), entry
            assert max(map(len, out.splitlines())) <= 80, entry


def test_an_unknown_plugin_is_refused(ran):
    code, _, err = ran("plugins", "show", "symetric")
    assert code == 2
    assert "did you mean 'symmetric'?" in err


@pytest.mark.parametrize("package", ["half-package", "half_package", "Half.Package", "made_up_cli"])
def test_check_passes_a_good_package(ran, third_party, package):
    code, out, _ = ran("plugins", "check", package)
    assert code == 0
    assert "half-package 1.0" in out
    assert "operator halving  pass" in out
    assert "1 of 1 plugins fulfil the contract" in out


def test_check_fails_a_bad_package_and_prints_the_reasons(ran, third_party, monkeypatch):
    monkeypatch.syspath_prepend(third_party)
    code, out, err = ran("plugins", "check", "bad-package")
    flat = " ".join(out.split())
    assert (code, err) == (1, "")
    assert "operator halving FAIL 1 of" in flat
    assert "its name is not used by another plugin: 2 installed packages offer a" in flat
    assert "operator absolute FAIL" in flat
    assert "scales with the gradients" in flat
    assert "compare lengths with each other" in flat
    assert "it can be loaded: ModuleNotFoundError: No module named 'made_up_lost'" in flat
    assert "0 of 3 plugins fulfil the contract" in flat
    places = [line.strip() for line in out.splitlines() if line.startswith("      at ")]
    assert max(len(line) for line in out.splitlines() if line.strip() not in places) <= 80
    file = third_party.parent / "good" / "made_up_cli.py"
    line = 1 + OPERATOR.splitlines().index("class Absolute(Halving):")
    assert f"at {file}:{line}" in places
    assert "at made_up_lost:A, from bad-package 1.0" in places


BROKEN = {
    "raises in a check": (
        "from crossgrad_core.plugin import GramianOperator\n"
        "class Halving(GramianOperator):\n"
        "    def transform(self, gramians, context, state, rng):\n"
        "        return gramians.no_such_thing, state\n",
        4,
    ),
    "raises at import": ("import numpy\nnumpy.no_such_thing\n", 2),
    "raises at construction": (
        "from crossgrad_core.plugin import Field, GramianOperator\n"
        "class Halving(GramianOperator):\n"
        "    share: float\n"
        "    def transform(self, gramians, context, state, rng):\n"
        "        return gramians, state\n",
        2,
    ),
    "is not Python": ("import numpy\n\nclass Halving(:\n", 3),
    "is of the wrong kind": ("\nclass Halving:\n    pass\n", 2),
    "is abstract": (
        "from crossgrad_core.plugin import Operator\n\n\nclass Halving(Operator):\n    pass\n",
        4,
    ),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_check_reports_the_file_and_the_line_of_a_defect(ran, tmp_path, monkeypatch, broken):
    source, line = BROKEN[broken]
    plugins = {"operators": {"halving": "made_up_broken:Halving"}}
    write_distribution(tmp_path, "broken-package", plugins, {"made_up_broken": source})
    monkeypatch.syspath_prepend(tmp_path)
    code, out, _ = ran("plugins", "check", "broken-package")
    sys.modules.pop("made_up_broken", None)
    assert code == 1
    assert f"      at {tmp_path / 'made_up_broken.py'}:{line}\n" in out


def test_an_import_error_of_a_plugin_is_reported_with_its_line(ran, tmp_path, monkeypatch):
    source, line = BROKEN["raises at import"]
    plugins = {"operators": {"halving": "made_up_broken:Halving"}}
    write_distribution(tmp_path, "broken-package", plugins, {"made_up_broken": source})
    monkeypatch.syspath_prepend(tmp_path)
    _, _, err = ran("plugins", "show", "halving")
    assert f"made_up_broken.py:{line}" in err


@pytest.mark.parametrize(
    ("package", "words"),
    [
        ("numpy", "package 'numpy' contains no plugins"),
        ("crossgrda", "did you mean 'crossgrad'?"),
        ("", "no package named"),
        ("..", "no package named"),
    ],
)
def test_check_refuses_a_package_without_plugins(ran, package, words):
    code, out, err = ran("plugins", "check", package)
    assert (code, out) == (2, "")
    assert words in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("runn",),
        ("run", "--operater", "sum"),
        ("run", "--steps"),
        ("run", "--steps", "many"),
        ("run", "a", "b"),
        ("plugins", "show"),
        ("eval",),
        ("render", "run", "--split", "both"),
    ],
    ids=" ".join,
)
def test_bad_usage_ends_with_one_message_and_code_2(ran, arguments):
    code, out, err = ran(*arguments)
    assert (code, out) == (2, "")
    assert err.count("Error: ") == 1
    assert "Traceback" not in err
    assert "─" not in err


def test_an_interrupt_ends_a_command_with_exit_code_130(ran, monkeypatch):
    def interrupted(slot):
        raise KeyboardInterrupt

    monkeypatch.setattr(registry, "offers", interrupted)
    code, _, err = ran("plugins", "list")
    assert (code, err) == (130, "interrupted\n")


def test_an_internal_error_keeps_its_traceback(monkeypatch):
    def broken(slot):
        raise RuntimeError("a bug")

    monkeypatch.setattr(registry, "offers", broken)
    before = sys.excepthook
    with pytest.raises(RuntimeError, match="a bug"):
        command.main(["plugins", "list"])
    assert sys.excepthook is before


def test_show_names_the_slot_that_contains_the_plugin(ran):
    code, _, err = ran("plugins", "show", "near-far", "--slot", "operators")
    assert code == 2
    assert "no plugin named 'near-far' among the operators" in err
    assert "a plugin with this name among the samplers" in err


def test_a_bad_value_is_reported_without_messages_of_pydantic(ran):
    for given in (("run", "--steps", "1e3"), ("render", "x", "--split", "foo")):
        code, _, err = ran(*given)
        assert code == 2
        assert given[-2] in err
        assert repr(given[-1]) in err
        assert not any(words in err for words in ("Input should", "Value error", "parse string"))
