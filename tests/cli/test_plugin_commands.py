"""Commands of plugins: listed without importing them, called by name, broken only when called."""

import sys

import pytest
from support.distributions import write_distribution
from typer.main import get_command

from crossgrad_core.cli.main import app, main
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import COMMANDS, OWN_COMMANDS

FUNCTION = '''
"""Greets."""

from typing import Annotated

import typer

from crossgrad_core.errors import UserError


def hello(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Whom.")] = "world",
    loud: Annotated[bool, typer.Option("--loud", help="Shout.", rich_help_panel="Voice")] = False,
) -> None:
    """Greet somebody.

    Or the world.
    """
    if name == "nobody":
        raise UserError("there is nobody", todo="name somebody")
    if name == "ctrl-c":
        raise KeyboardInterrupt
    typer.echo(f"hello {name}".upper() if loud else f"hello {name}")


seven = 7
'''
APP = '''
"""Compare runs."""

import typer

app = typer.Typer(help="Compare runs.")


@app.command()
def two(one: str, other: str) -> None:
    """Compare two runs."""
    typer.echo(f"{one} {other}")


@app.command()
def stopped() -> None:
    """Stop."""
    raise KeyboardInterrupt
'''
MODULES = {"made_up_hello": FUNCTION, "made_up_app": APP, "made_up_broken": "import no_such_thing"}
NAMES = {
    "hello": "made_up_hello:hello",
    "compares": "made_up_app:app",
    "broken": "made_up_broken:command",
    "gone": "made_up_hello:gone",
    "seven": "made_up_hello:seven",
    "nowhere": "made_up_nowhere.inner:command",
    "run": "made_up_hello:hello",
}


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")


@pytest.fixture
def installed(tmp_path, monkeypatch):
    write_distribution(tmp_path / "one", "made-up", {COMMANDS: NAMES}, MODULES)
    monkeypatch.syspath_prepend(tmp_path / "one")
    yield tmp_path
    for module in MODULES:
        sys.modules.pop(module, None)


@pytest.fixture
def ran(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        printed = capsys.readouterr()
        return ended.value.code, printed.out, printed.err

    return run


def rows(out):
    return dict(row.split(None, 1) for row in out.partition("Commands:\n")[2].splitlines() if row)


@pytest.mark.usefixtures("installed")
def test_help_lists_all_plugin_commands_without_an_import(ran):
    code, out, err = ran("--help")
    found = rows(out)
    assert (code, err) == (0, "")
    assert found["hello"] == "Greet somebody."
    assert found["compares"] == "Compare runs."
    for name in ("broken", "gone", "nowhere"):
        assert found[name] in {"from made-up 1.0", "Greets."}
    assert not sys.modules.keys() & MODULES.keys()


@pytest.mark.usefixtures("installed")
def test_a_plugin_command_does_not_replace_a_core_command(ran):
    assert rows(ran("--help")[1])["run"].startswith("Train on a scene")
    assert ran("run", "nobody", "--steps", "0")[0] == 2


@pytest.mark.usefixtures("installed")
def test_a_function_command_is_called_with_its_options(ran):
    assert ran("hello", "you", "--loud") == (0, "HELLO YOU\n", "")
    code, out, _ = ran("hello", "-h")
    assert code == 0
    assert out.startswith("Usage: crossgrad hello [OPTIONS] [NAME]\n")
    assert "\nVoice:\n  --loud" in out


@pytest.mark.usefixtures("installed")
def test_a_typer_app_adds_its_own_subcommands(ran):
    assert ran("compares", "two", "a", "b") == (0, "a b\n", "")
    code, out, _ = ran("compares", "--help")
    assert code == 0
    assert "Compare two runs." in out


@pytest.mark.usefixtures("installed")
def test_bad_input_is_reported_alike_by_plugin_and_core_commands(ran):
    assert ran("hello", "nobody") == (2, "", "error: there is nobody\n  to do:    name somebody\n")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("arguments", [("hello", "ctrl-c"), ("compares", "stopped")])
def test_an_interrupt_ends_a_plugin_command_with_exit_code_130(ran, arguments):
    assert ran(*arguments) == (130, "", "interrupted\n")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("broken", "ModuleNotFoundError: No module named 'no_such_thing'"),
        ("gone", "no attribute 'gone'"),
        ("nowhere", "No module named 'made_up_nowhere'"),
        ("seven", "a typer.Typer, or a function"),
    ],
)
def test_a_broken_command_gives_one_error_when_it_is_called(ran, name, words):
    code, out, err = ran(name)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: command {name} cannot be ")
    assert words in err
    assert "made-up 1.0" in err
    assert "Traceback" not in err


def test_a_command_name_of_two_packages_is_refused(ran, installed, monkeypatch):
    write_distribution(installed / "two", "other", {COMMANDS: {"hello": "made_up_hello:hello"}})
    monkeypatch.syspath_prepend(installed / "two")
    code, _, err = ran("hello")
    assert code == 2
    assert "2 installed packages offer a command named 'hello'" in err


@pytest.mark.usefixtures("installed")
def test_the_right_name_is_suggested_for_a_misspelt_command(ran):
    code, _, err = ran("helo")
    assert code == 2
    assert "Did you mean 'hello'?" in err


@pytest.mark.usefixtures("installed")
def test_the_list_of_plugins_includes_commands(ran):
    out = ran("plugins", "list")[1]
    assert "\ncommands\n" in out
    assert "  hello     made-up 1.0\n" in out
    assert "  diagnose  crossgrad" in out
    assert "  run       made-up 1.0  never called: the core has a command with this name\n" in out
    assert ran("plugins", "list", "--slot", "command")[1].startswith("commands\n  broken")


@pytest.mark.usefixtures("installed")
def test_show_explains_a_command(ran):
    code, out, _ = ran("plugins", "show", "hello")
    assert code == 0
    assert "command hello, from made-up 1.0" in out
    assert "`crossgrad hello --help` explains its options" in out


@pytest.mark.usefixtures("installed")
def test_check_reports_on_commands(ran):
    code, out, _ = ran("plugins", "check", "made-up")
    assert code == 1
    assert "command hello     pass  3 checks" in out
    assert "command compares  pass  3 checks" in out
    for name in ("broken", "gone", "seven", "nowhere", "run"):
        assert f"command {name:<8}  FAIL  1 of 1 checks" in out


def test_check_reports_a_command_that_imports_slowly_or_has_no_help(ran, tmp_path, monkeypatch):
    source = "import numpy\n\ndef slow() -> None:\n    pass\n"
    commands = {COMMANDS: {"slow": "made_up_slow:slow"}}
    write_distribution(tmp_path, "made-up-slow", commands, {"made_up_slow": source})
    monkeypatch.syspath_prepend(tmp_path)
    code, out, _ = ran("plugins", "check", "made-up-slow")
    sys.modules.pop("made_up_slow", None)
    flat = " ".join(out.split())
    assert code == 1
    assert "the command has no help" in flat
    assert "importing made_up_slow imports numpy" in flat


def test_the_bundled_commands_are_entry_points_of_crossgrad():
    ours = {name for name, entry in registry.entries(COMMANDS).items()
            if entry.distribution == "crossgrad"}  # fmt: skip
    assert {"diagnose", "plugins", "stress"} <= ours


def test_the_list_of_core_commands_is_complete():
    assert tuple(get_command(app).commands) == OWN_COMMANDS
