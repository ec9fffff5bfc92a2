"""Commands whose options are fields of a dataclass."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from crossgrad_core.commands import argument, command_of, option
from crossgrad_core.registry.commands import as_group_member


@dataclass(frozen=True)
class Options:
    scene: Path = argument("SCENE", "Scene folder.")
    seeds: list[int] | None = option(None, "A seed, repeatable.", "N", flag="--seed", min=0)
    name: str = option("plain", "A name.", "NAME", heading="Names")


@command_of(Options)
def show(given: Options) -> None:
    """Show what was given."""
    typer.echo(given)


@pytest.fixture(name="ran")
def _ran(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            as_group_member(show, "show").main(arguments, "show")
        return ended.value.code, capsys.readouterr().out

    return run


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        (("a",), Options(Path("a"))),
        (("a", "--seed", "1", "--seed", "2"), Options(Path("a"), [1, 2])),
        (("--name", "b", "a"), Options(Path("a"), name="b")),
    ],
)
def test_the_command_function_receives_the_given_options(ran, arguments, given):
    assert ran(*arguments) == (0, f"{given}\n")


@pytest.mark.parametrize("arguments", [(), ("a", "--seed", "-1"), ("a", "--seeds", "1")])
def test_missing_unknown_and_out_of_bounds_options_are_refused(ran, arguments):
    assert ran(*arguments)[0] == 2


def test_the_help_lists_options_below_their_headings(ran):
    code, text = ran("--help")
    assert code == 0
    assert "Show what was given." in text
    assert "A name." in text.partition("Names:")[2]
