"""The command `crossgrad plan`."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from shutil import get_terminal_size

from crossgrad_core.commands import (
    UserError,
    check_file,
    configured,
    merged,
    one_line,
    read_scene,
    write_settings,
)
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.planner import Plan, plan_of
from crossgrad_plugins.planner.sizes import length
from crossgrad_plugins.planner.terminal import lines_of

#: Columns where nothing tells how many there are.
_COLUMNS = 120


def plan(
    file: Path | None,
    options: Mapping[str, object],
    assignments: Sequence[str],
    probe_seconds: float | None,
    write: Path | None,
) -> tuple[Plan, str]:
    """What the scene calls for, and how to run it.

    Args:
        file: Configuration file of the run, or None.
        options: Options of the run that the user gave; None stands for nothing.
        assignments: `KEY=VALUE` texts.
        probe_seconds: Training seconds of a probe, or None.
        write: Where the run's settings go, or None.

    Returns:
        The plan, and the command that carries it out.

    Raises:
        UserError: The input is bad, or the file cannot be written; nothing was written.
    """
    if write is not None:
        _check_free(write)
    settings = merged(file, options, assignments)
    # Without a plan the bundled scene has a bound on its views, which is the plan's to decide.
    config = configured({**settings, "plan": "auto"})
    scene, _ = read_scene(config)
    made = plan_of(config, scene, probe_seconds)
    if write is not None:
        # The bundled scene has a length by itself, which it would lose where the file names it.
        seconds = {} if config.seconds is None else {"seconds": config.seconds}
        # Of another folder, too.
        asked = {**settings, **seconds, "scene": str(Path(str(config.scene)).resolve())}
        write_settings(write, {**made.applied_to(asked), "plan": "off"})
        return made, f"run it: crossgrad run --config {quote(str(write))}"
    if probe_seconds is not None:
        return made, "--write FILE keeps this for crossgrad run --config FILE"
    named = None if options.get("scene") is None else config.scene
    return made, f"run it: {_command(named, {**options, 'config': file}, assignments)}"


def advised(scene: Path) -> tuple[str, str]:
    """Return the length that the planner advises for a scene, and the command that trains it so.

    No photo is decoded.

    Raises:
        UserError: The scene cannot be read.
    """
    config = configured({"scene": str(scene), "plan": "auto"})
    decision = length(Evidence(config, read_scene(config)[0]))
    return f"{decision.choice}, {decision.evidence}", _command(scene, {}, [])


def _command(scene: Path | None, options: Mapping[str, object], assignments: Sequence[str]) -> str:
    """The command that trains a scene as planned; the bundled one where none is named."""
    given = {"plan": "auto", **options, "scene": None}
    words = ["crossgrad run"] if scene is None else ["crossgrad run", quote(str(scene))]
    words += [f"--{name.replace('_', '-')} {_word(each)}" for name, each in given.items() if each]
    words += [f"--set {quote(each)}" for each in assignments]
    return " ".join(words)


def _word(value: object) -> str:
    """A value of an option as a shell reads it."""
    return quote(f"{value:.10g}" if isinstance(value, float) else str(value))


def show(made: Plan, way: str, *, as_json: bool) -> None:
    """Prints a plan, and the command that carries it out."""
    if as_json:
        print(json.dumps(made.as_data(), indent=2))  # noqa: T201
        return
    for line in lines_of(made, get_terminal_size((_COLUMNS, 0)).columns):
        print(one_line(line))  # noqa: T201 - the result of the command
    print(one_line(way))  # noqa: T201


def _check_free(file: Path) -> None:
    if file.exists():
        raise UserError(
            "the file is there already",
            where=f"--write {file}",
            todo="choose another name, or remove it",
        )
    check_file(file)
