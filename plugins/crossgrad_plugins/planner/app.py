"""The command `crossgrad plan`."""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from shlex import quote
from shutil import get_terminal_size
from textwrap import wrap
from typing import Final

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
from crossgrad_plugins.planner.finding import Finding
from crossgrad_plugins.planner.length import length
from crossgrad_plugins.planner.planner import Plan, plan_of

#: In terminals with fewer columns, cost and option of a decision are printed below its evidence.
_WIDE: Final = 110
_HEADER: Final = ("part", "decision", "evidence", "cost saved", "force with")
#: Widths of the columns in a wide table. The evidence column gets the remaining width.
_WIDTHS: Final = (14, 20, 0, 18, 23)
_GAP: Final = "  "
#: Origin of a choice -> text that is printed after the choice.
_MARKS: Final = {"decided": "", "default": " (default)", "given": " (yours)"}


def lines_of(plan: Plan, width: int) -> Iterator[str]:
    """Yield the table of findings and the changed settings, in lines of `width` characters."""
    rows = [_HEADER, *map(_cells, plan.findings)]
    for row in rows:
        yield from _wide(row, width) if width >= _WIDE else _narrow(row, width)
        if row is _HEADER or width < _WIDE:
            yield ""
    if width >= _WIDE:
        yield ""
    changed = [f"{name} = {value}" for name, value in plan.settings.items()]
    summary = f"changed: {', '.join(changed)}" if changed else "no settings changed"
    yield from wrap(f"{summary}; default: the evidence is missing or not conclusive", width)
    yield f"decided in {plan.seconds:.1f} s"


def _cells(finding: Finding) -> tuple[str, ...]:
    choice = f"{finding.choice}{_MARKS[finding.basis]}"
    return (finding.part, choice, finding.evidence, finding.saved, finding.force)


def _wide(row: Sequence[str], width: int) -> Iterator[str]:
    """Yield the lines of a finding in columns; each cell is wrapped."""
    rest = width - sum(_WIDTHS) - len(_GAP) * (len(_WIDTHS) - 1)
    widths = [column_width or rest for column_width in _WIDTHS]
    cells = [_wrapped(text, space) for text, space in zip(row, widths, strict=True)]
    for lines in zip_longest(*cells, fillvalue=""):
        padded = (line.ljust(space) for line, space in zip(lines, widths, strict=True))
        yield _GAP.join(padded).rstrip()


def _narrow(row: Sequence[str], width: int) -> Iterator[str]:
    """Yield the lines of a finding as a block: decision, evidence, cost and option."""
    part, choice, *below = row
    indent = " " * (_WIDTHS[0] + len(_GAP))
    yield f"{part.ljust(_WIDTHS[0])}{_GAP}{choice}"
    if row is _HEADER:
        yield indent + ", ".join(below)
        return
    evidence, saved, force = below
    for text in (evidence, f"saves {saved}" if saved != "-" else "", f"force with {force}"):
        yield from (indent + line for line in _wrapped(text, width - len(indent)) if line)


def _wrapped(text: str, width: int) -> list[str]:
    return wrap(text, max(1, width), break_on_hyphens=False) or [""]


#: Width of the output if the width of the terminal is unknown.
_COLUMNS = 120


def plan(
    file: Path | None,
    options: Mapping[str, object],
    assignments: Sequence[str],
    probe_seconds: float | None,
    write: Path | None,
) -> tuple[Plan, str]:
    """Plan a run on a scene, and return the plan and the command that starts the run.

    Args:
        file: Configuration file of the run, or None.
        options: Options of the run from the command line; None means that an option was not given.
        assignments: Texts `KEY=VALUE`.
        probe_seconds: Training time in seconds for a probe, a short run that measures gradients;
            None for no probe.
        write: Output file for the run's settings, or None.

    Returns:
        The plan, and the command that runs it.

    Raises:
        UserError: An input is invalid, or the file cannot be written. In both cases, no file is
            written.
    """
    if write is not None:
        _check_free(write)
    settings = merged(file, options, assignments)
    config = configured(settings)
    scene, _ = read_scene(config)
    made = plan_of(config, scene, probe_seconds)
    if write is not None:
        # Write the time limit too, because the default length of the bundled scene does not apply
        # if the file names the scene.
        seconds = {} if config.seconds is None else {"seconds": config.seconds}
        # Write an absolute path, so that the file can be used from another folder.
        asked = {**settings, **seconds, "scene": str(Path(str(config.scene)).resolve())}
        write_settings(write, {**made.applied_to(asked), "plan": "off"})
        return made, f"run it: crossgrad run --config {quote(str(write))}"
    if probe_seconds is not None:
        return made, "use --write FILE to save these settings for `crossgrad run --config FILE`"
    named = None if options.get("scene") is None else config.scene
    return made, f"run it: {_command(named, {**options, 'config': file}, assignments)}"


def advised(scene: Path) -> tuple[str, str]:
    """Return the length that the planner recommends for a scene, and the training command.

    No photo is decoded.

    Raises:
        UserError: The scene cannot be read.
    """
    config = configured({"scene": str(scene)})
    decision = length(Evidence(config, read_scene(config)[0]))
    return f"{decision.choice}, {decision.evidence}", _command(scene, {}, [])


def _command(scene: Path | None, options: Mapping[str, object], assignments: Sequence[str]) -> str:
    """Return the command that trains a scene as planned.

    Without a scene, the bundled scene is used.
    """
    given = {**options, "scene": None}
    words = ["crossgrad run"] if scene is None else ["crossgrad run", quote(str(scene))]
    words += [
        f"--{name.replace('_', '-')} {_word(value)}" for name, value in given.items() if value
    ]
    words += [f"--set {quote(assignment)}" for assignment in assignments]
    return " ".join(words)


def _word(value: object) -> str:
    """Format the value of an option for a shell."""
    return quote(f"{value:.10g}" if isinstance(value, float) else str(value))


def show(made: Plan, way: str, *, as_json: bool) -> None:
    """Print a plan, and the command that carries it out."""
    if as_json:
        print(json.dumps(made.as_data(), indent=2))  # noqa: T201
        return
    for line in lines_of(made, get_terminal_size((_COLUMNS, 0)).columns):
        print(one_line(line))  # noqa: T201 - print the result of the command
    print(one_line(way))  # noqa: T201


def _check_free(file: Path) -> None:
    if file.exists():
        raise UserError(
            "the output file already exists",
            where=f"--write {file}",
            todo="choose another name, or remove the file",
        )
    check_file(file)
