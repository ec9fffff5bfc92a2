"""The command `crossgrad diagnose`."""

import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from crossgrad_core.commands import (
    FAILED,
    TrainingFailedError,
    UserError,
    check_file,
    check_folder,
    check_new,
    configured,
    disk_errors,
    one_line,
    open_run,
)
from crossgrad_plugins.diagnostics.command import Options, diagnose_run, diagnose_scene
from crossgrad_plugins.diagnostics.report import FILES, PICTURE, PROBES, Report


def diagnose(
    scene: Path | None,
    run: Path | None,
    settings: Mapping[str, object],
    options: Options,
    out: Path | None,
    accept_scene: bool = False,
) -> int:
    """Diagnoses a scene or a run; prints the report and writes it to a folder.

    Args:
        scene: Scene folder; the bundled one where neither a scene nor a run is given.
        run: Folder of a run to probe, or None.
        settings: Settings of the vanilla run in the shape of `RunConfig` (reading, device ...); of
            a run only `device` and `threads` can be set.
        options: How to probe.
        out: Where the report goes.
        accept_scene: Of a run, take its scene although parts of it have changed.

    Returns:
        The exit code: 0, or 1 where training failed; the probes before that are reported.

    Raises:
        UserError: The input is bad.
    """
    if scene is not None and run is not None:
        raise UserError(
            "either a scene is diagnosed or a run",
            where="SCENE, --run",
            todo="leave SCENE out: the run knows its scene",
        )
    _check_free(out)
    check_folder(out or run or Path("runs"))
    if options.signature is not None:
        check_file(options.signature)
        check_new(options.signature)
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    if run is not None:
        setup, state = open_run(run, settings, accept_scene=accept_scene)
        report = diagnose_run(setup, state, run, options)
        folder = out or run / "diagnose" / stamp
    else:
        config = configured({**settings, "scene": scene})
        try:
            report = diagnose_scene(config, options)
        except TrainingFailedError as error:
            return _failed(f"{error}; nothing was probed before")
        folder = out or Path("runs") / report.scene / "diagnose" / stamp
    _write(report, folder)
    return 0 if report.failure is None else _failed(report.failure)


def _failed(why: str) -> int:
    print(f"training failed: {why}", file=sys.stderr)  # noqa: T201
    return FAILED


def _check_free(out: Path | None) -> None:
    if out is not None and (out / PROBES).exists():
        raise UserError(
            "the folder holds a report already",
            where=out,
            todo="choose another --out, or remove it",
        )
    if out is not None:
        check_new(*(out / name for name in FILES))


def _write(report: Report, folder: Path) -> None:
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    report.write(folder)
    for line in report.lines():
        print(one_line(line))  # noqa: T201 - the result of the command
    print(f"\ntables and {PICTURE} in {one_line(folder)}")  # noqa: T201
