"""Options that cannot stand beside `--resume`: all that would change the training."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from crossgrad_core.errors import UserError
from crossgrad_core.run.changeable_settings import CHANGEABLE
from crossgrad_core.wording import listed

#: What only this start of the command is asked.
_OF_THE_COMMAND: Final = frozenset(
    {"resume", "accept_scene", "accept_plugins", "check", "quiet", "verbose"}
)


def refuse_beside_resume(run: Path, given: Mapping[str, object]) -> None:
    """Refuses what the user typed beside `--resume` where the run would not heed it.

    Args:
        run: The folder that goes on.
        given: Option name -> value; None, False and empty lists where the user did not give it.

    Raises:
        UserError: Names each of them as the user typed it.
    """
    typed = list(_typed(given))
    if typed:
        raise UserError(
            "a resumed run keeps its settings and its scene",
            where=listed(typed),
            expected="--device, --threads, --stop-after, --accept-scene, --accept-plugins, "
            "--check, -q and -v, and nothing else",
            todo=f"leave {'it' if len(typed) == 1 else 'them'} out to continue {run}, or leave "
            "--resume out to start a new run",
        )


def _typed(given: Mapping[str, object]) -> Iterator[str]:
    for name, value in given.items():
        if value in (None, False, []) or name in CHANGEABLE | _OF_THE_COMMAND:
            continue
        if name == "scene":
            yield "SCENE"
        elif name == "assignments" and isinstance(value, list):
            keys = (str(each).partition("=")[0] for each in value)
            yield from (f"--set {key}" for key in keys if key.strip() not in CHANGEABLE)
        else:
            yield f"--{name.replace('_', '-')}"
