"""Read runs from folders.

Broken and unfinished runs are left out or refused.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from sys import float_info
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import BaseModel, Field, ValidationError

from crossgrad_core.commands import (
    RunConfig,
    UserError,
    check_unchanged,
    find_runs,
    read_results,
    read_rows,
)
from crossgrad_plugins.compare.run import Run

if TYPE_CHECKING:
    from crossgrad_core.commands import RunResults

#: Name of the table of a sweep; the table is in the folder that contains the folder of the runs.
_PLAN: Final = "runs.csv"
_ID, _LABEL = "run", "configuration"
_LENGTHS: Final = ("steps=", "max_views=", "seconds=")
#: Label of a grid's arm if the grid has only one.
_ONLY: Final = "run"
_REPEAT: Final = "restore the file, or repeat the run: crossgrad run --config config.yaml"
_OVERSIZED: Final = "a whole number that is too large"


class _Seconds(BaseModel):
    """The seconds in summary.json that are added up."""

    phases: dict[str, Annotated[float, Field(strict=True, allow_inf_nan=False)]] | None = None


class _Summary(BaseModel):
    """The entries of summary.json that a comparison needs."""

    status: str
    scene: str
    step: int
    overall: dict[str, float | None] | None
    regimes: dict[str, dict[str, float | None]]
    notes: list[str] = []
    definitions: dict[str, str] = {}
    environment: dict[str, Any] = {}
    seconds: _Seconds = _Seconds()


@dataclass
class RunRecord:
    """The runs that were found in folders.

    Attributes:
        runs: The finished runs.
        failed: The failed runs, which never reach a quality.
        left_out: Folder -> reason why it is not compared.
    """

    runs: list[Run] = field(default_factory=list)
    failed: list[Run] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


def read_runs(places: Sequence[Path], *, skip_broken: bool) -> RunRecord:
    """Read every run in the given folders or below; each run is read once.

    Args:
        places: Folders of runs, or folders that contain such folders.
        skip_broken: True to leave out a run with a damaged file instead of raising an error.

    Raises:
        UserError: A folder contains no run, or a file of a run is damaged.
    """
    record = RunRecord()
    folders = list(dict.fromkeys(folder for path in places for folder in _folders(path)))
    names = _short_names(folders)
    labels = {parent: _labels(parent) for parent in {folder.parent for folder in folders}}
    for folder in dict.fromkeys(headless for path in places for headless in _headless(path)):
        if not skip_broken:
            raise UserError(
                "the folder contains results of a run, but no config.yaml",
                where=folder,
                todo="restore the file, or move the folder away; --skip-broken ignores this run "
                "and compares the other runs",
            )
        record.left_out[str(folder)] = "has no config.yaml"
    for folder in folders:
        try:
            results = read_results(folder)
            for label in labels[folder.parent].get(folder.name, (None,)):
                _sort_in(record, names[folder], results, label)
        except UserError as error:
            if not skip_broken:
                raise _broken(error) from error
            record.left_out[names[folder]] = f"{error.what}: {error.where}"
    return record


def check_places(places: Sequence[Path]) -> None:
    """Refuse paths that are not folders, before the output folder is checked.

    Raises:
        UserError: A path is a file, or does not exist.
    """
    for path in places:
        if not path.is_dir():
            raise _no_run(path)


def _folders(path: Path) -> Iterator[Path]:
    folders = find_runs(path) if path.is_dir() else ()
    if not folders:
        raise _no_run(path)
    yield from (folder.resolve() for folder in folders)


def _no_run(path: Path) -> UserError:
    there = "a file" if path.is_file() else "the folder does not exist"
    return UserError(
        "there is no run to compare",
        where=path,
        expected="the folder of a run, or a folder that contains runs",
        found="no config.yaml" if path.is_dir() else there,
        todo="name the folder that `crossgrad run` or `crossgrad sweep` printed",
    )


def _headless(root: Path) -> Iterator[Path]:
    """Yield folders that contain results of a run but not its config.yaml."""
    for path in sorted(root.rglob("summary.json")):
        folder = path.parent
        if (folder / "metrics.csv").exists() and not (folder / "config.yaml").exists():
            yield folder.resolve()


def _broken(error: UserError) -> UserError:
    return UserError(
        error.what,
        where=error.where,
        expected=error.expected,
        found=error.found,
        todo=f"{error.todo}; --skip-broken ignores this run and compares the other runs",
    )


def _sort_in(record: RunRecord, name: str, results: "RunResults", label: str | None) -> None:
    if results.summary is None:
        record.left_out[name] = "has not finished: no summary.json"
        return
    _check_summary(results)
    run = Run(name, results, results.summary, _config(results), label)
    if run.status == "failed":
        record.failed.append(run)
        record.left_out[name] = f"failed: {' '.join(str(run.summary.get('error')).split())}"
    elif run.status != "finished":
        record.left_out[name] = "was stopped before its end"
    elif not results.rows and not (run.summary.get("overall") or {}).get("views"):
        record.left_out[name] = "was never evaluated: metrics.csv has no row"
    else:
        _check_whole(results)
        record.runs.append(run)


def _check_whole(results: "RunResults") -> None:
    """Refuse a finished run with a truncated or missing file.

    The metrics of such a run would be wrong.

    Raises:
        UserError: metrics.csv ends before the end of the run or contains too large a number,
            held-out views have no metrics, or scene.json cannot be read.
    """
    # Read scene.json here, because this raises an error if the file is malformed.
    views = (results.scene_marks or {}).get("views") or {}
    if not all(isinstance(view, Mapping) for view in views.values()):
        raise UserError(
            "scene.json cannot be read",
            where=results.folder / "scene.json",
            expected="an object for each view, with the fingerprint of its photo",
            todo=_REPEAT,
        )
    if _oversized(list(results.rows)):
        raise UserError(
            "metrics.csv cannot be read",
            where=results.folder / "metrics.csv",
            found=_OVERSIZED,
            todo=_REPEAT,
        )
    summary = results.summary or {}
    last = results.rows[-1].get("step") if results.rows else None
    steps = summary.get("step")
    if last != steps:
        raise UserError(
            "metrics.csv ends before the last step of the run",
            where=results.folder / "metrics.csv",
            expected=f"a last row for step {steps}, as in summary.json",
            found=f"a last row for step {last:.0f}" if last is not None else "no row with a step",
            todo=_REPEAT,
        )
    if (summary.get("overall") or {}).get("views") and not results.views:
        raise UserError(
            "the file with the metrics of the held-out views is missing",
            where=results.folder / "per_view.csv",
            expected="a row for each held-out view",
            found="no such file, or an empty one",
            todo=f"`crossgrad eval {results.folder}` writes the file again",
        )


def _check_summary(results: "RunResults") -> None:
    problem = _OVERSIZED if _oversized(results.summary) else ""
    try:
        _Summary.model_validate(results.summary)
    except ValueError as error:
        problem = _in_words(error)
    if problem:
        raise UserError(
            "summary.json cannot be read",
            where=results.folder / "summary.json",
            found=problem,
            todo=_REPEAT,
        )


def _oversized(content: object) -> bool:
    """Return True if a number in nested lists and objects is too large for a float."""
    rest = [content]
    while rest:
        item = rest.pop()
        if isinstance(item, Mapping):
            rest += item.values()
        elif isinstance(item, list):
            rest += item
        elif isinstance(item, int) and abs(item) > float_info.max:
            return True
    return False


def _in_words(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return " ".join(str(error).split())
    problems = error.errors(include_url=False, include_context=False)
    return "; ".join(
        f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in problems
    )


def _config(results: "RunResults") -> dict[str, object]:
    try:
        return RunConfig.model_validate(results.config).model_dump(mode="json")
    except ValueError as error:
        raise UserError(
            "the configuration of a run cannot be read",
            where=results.folder / "config.yaml",
            found=_in_words(error),
            todo="restore the file, or use the version of crossgrad that wrote it",
        ) from error


def _labels(folder: Path) -> dict[str, tuple[str, ...]]:
    """Return the labels of a sweep by name of the run's folder, or nothing without a sweep.

    A run that belongs to two configurations of the sweep has two labels.
    """
    plan = folder.parent / _PLAN
    if not plan.is_file():
        return {}
    todo = "remove it: the command of the sweep writes it again"
    check_unchanged(plan.parent, [plan.name], todo)
    header, *lines = read_rows(plan, "the table of the sweep", "restore it, or remove it") or [[]]
    if not {_ID, _LABEL} <= set(header):
        return {}
    at, called = header.index(_ID), header.index(_LABEL)
    labels: dict[str, tuple[str, ...]] = {}
    for line in lines:
        if len(line) == len(header):
            labels[line[at]] = tuple(
                dict.fromkeys((*labels.get(line[at], ()), without_length(line[called])))
            )
    return labels


def without_length(label: str) -> str:
    """Remove from a label the length, and the name of a grid's only arm."""
    parts = [part for part in label.split(", ") if not part.startswith(_LENGTHS)]
    named = parts[1:] if parts[:1] == [_ONLY] else parts
    return ", ".join(named or parts)


def _short_names(folders: Sequence[Path]) -> dict[Path, str]:
    """Return each folder's path relative to the innermost folder that contains all of them."""
    shared = os.path.commonpath([folder.parent for folder in folders])
    return {folder: folder.relative_to(shared).as_posix() for folder in folders}
