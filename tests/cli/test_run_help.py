"""`crossgrad run --help` shows what most users need, `--help-all` shows every option."""

import re

import pytest
from typer.main import get_command

from crossgrad_core.cli.main import app, main
from crossgrad_core.registry.commands import as_group_member, load_command
from crossgrad_core.registry.entries import entries
from crossgrad_core.registry.slots import COMMANDS

RUN = get_command(app).commands["run"]
#: Options that are about the help itself.
OF_THE_HELP = {"--help", "--help-all"}


def shown(capsys, *arguments):
    with pytest.raises(SystemExit, match="0"):
        main(arguments)
    return capsys.readouterr().out


@pytest.fixture(autouse=True)
def _columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")


def options_in(text):
    return {*re.findall(r"^  (?:-\w, )?(--[\w-]+)", text, re.MULTILINE)}


def test_the_help_has_20_options_on_60_lines_of_100_columns(capsys):
    lines = shown(capsys, "run", "--help").splitlines()
    assert len(options_in("\n".join(lines)) - OF_THE_HELP) == 20
    assert len(lines) <= 60
    assert max(map(len, lines)) <= 100
    assert any("--help-all" in line for line in lines)


def test_help_all_lists_every_option(capsys):
    few, every = (options_in(shown(capsys, "run", flag)) for flag in ("--help", "--help-all"))
    options = {each.opts[0] for each in RUN.params if each.param_type_name == "option"}
    assert every == options | {"--help"}
    assert few < every


def test_help_is_short_again_after_help_all(capsys):
    before = shown(capsys, "run", "--help")
    shown(capsys, "run", "--help-all")
    assert shown(capsys, "run", "--help") == before


def commands():
    offered = ((name, load_command(entry)) for name, entry in entries(COMMANDS).items())
    known = {name: as_group_member(command, name) for name, command in offered}
    return {**get_command(app).commands, **known}


@pytest.mark.parametrize("name", sorted(commands()))
def test_the_help_explains_no_default_at_length(name):
    for parameter in commands()[name].params:
        for default in re.findall(r"Default: (.*)\.", getattr(parameter, "help", None) or ""):
            assert len(default) <= 60, (parameter.name, default)
