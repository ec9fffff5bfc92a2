"""summary.json, which contains the final results of a run, its settings and its environment."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.figure import Figure
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.result import EvaluationResult, Means
from crossgrad_core.run.results.metrics_csv import Row, Totals
from crossgrad_core.system.files import text_bytes, write_atomically
from crossgrad_core.system.text_files import read_json

if TYPE_CHECKING:
    from crossgrad_core.contract.blocks import Json
    from crossgrad_core.training.state import Clock


FILE = "summary.json"
Status = Literal["finished", "stopped", "failed"]
#: Definition of the compared images, because metrics of different programs are comparable only with
#: equal definitions.
RENDERS = "rounded to 8 bits per channel before comparison; masked pixels do not count"


@dataclass(frozen=True, eq=False)
class Summary:
    """The contents of summary.json.

    Attributes:
        status: Status of the run at its end.
        scene: Name of the scene.
        totals: The cost of the run: steps, views, backward passes, time, primitives and memory.
        result: The last evaluation; None without an evaluation.
        rows: All rows of metrics.csv, from which the best evaluation is determined.
        seconds: Wall-clock seconds of training, loading and other activities; training seconds also
            by phase.
        config: The resolved configuration as plain data, including the seed.
        environment: Data of the machine, and versions of packages.
        ply: Description of the PLY file; None if no file was written.
        page: Name of the page that shows the scene in a browser; None if no page was written.
        notes: Messages about the run's choices, with reasons.
        decisions: The table of decided settings.
        check: Results of the consistency check of the scene; None without a check.
        error: The reason of the failure; None if the run did not fail.
    """

    status: Status
    scene: str
    totals: Totals
    result: EvaluationResult | None
    rows: Sequence[Row]
    seconds: "Clock"
    config: Mapping[str, Any]
    environment: "Mapping[str, Json]"
    ply: "Mapping[str, Json] | None" = None
    page: str | None = None
    notes: Sequence[str] = ()
    decisions: Sequence[Decision] = ()
    check: "Mapping[str, Json] | None" = None
    error: str | None = None


def write_summary(folder: Path, summary: Summary) -> None:
    """Write summary.json; NaN and infinity become null, because JSON cannot store these numbers.

    Raises:
        UserError: The disk is full.
    """
    text = json.dumps(_finite(_as_data(summary)), indent=2, ensure_ascii=False, default=str)
    write_atomically(folder / FILE, text_bytes(text + "\n"))


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the content of a run's summary.json.

    Raises:
        UserError: The file does not exist, or it is not valid JSON.
    """
    path = folder / FILE
    if not path.is_file():
        raise UserError(
            f"the folder does not contain {FILE}",
            where=folder,
            expected="the folder of a crossgrad run",
            todo="name the folder of a finished run",
        )
    try:
        content, found = read_json(path), "a value that is not an object"
    except ValueError as error:
        content, found = None, str(error)
    if isinstance(content, dict):
        return content
    raise UserError(
        f"{FILE} cannot be read",
        where=path,
        found=found,
        todo="restore the file, or repeat the run: crossgrad run --config config.yaml",
    )


def summarised_step(folder: Path, status: Status | None = None) -> int | None:
    """Return the step in summary.json; None without the file or if the run has another status."""
    try:
        summary = read_summary(folder)
    except UserError:
        return None
    step = summary.get("step") if status in (None, summary.get("status")) else None
    return step if isinstance(step, int) else None


def _as_data(summary: Summary) -> dict[str, Any]:
    figures = () if summary.result is None else summary.result.figures
    return {
        "status": summary.status,
        "error": summary.error,
        "scene": summary.scene,
        **asdict(summary.totals),
        **_metrics(summary.result),
        "best": best_of(summary.rows),
        "ply": None if summary.ply is None else dict(summary.ply),
        "page": summary.page,
        "seconds": {
            name: value for name, value in asdict(summary.seconds).items() if name != "cpu"
        },
        "seed": summary.config.get("seed"),
        "notes": list(summary.notes),
        "decisions": [asdict(row) for row in summary.decisions],
        "scene_check": None if summary.check is None else dict(summary.check),
        "definitions": _definitions(figures),
        "falling": [figure.name for figure in figures if figure.falls],
        "environment": dict(summary.environment),
        "config": dict(summary.config),
    }


def _metrics(result: EvaluationResult | None) -> dict[str, Any]:
    if result is None:
        return {"overall": None, "regimes": {}, "null": {"overall": "no evaluation was made"}}
    return {
        "overall": result.overall.as_data(),
        "regimes": {name: means.as_data() for name, means in result.regimes.items()},
        "null": dict(result.reasons),
    }


def _definitions(figures: Sequence[Figure]) -> dict[str, str]:
    stated = {figure.name: figure.definition for figure in figures if figure.definition}
    return {**stated, "renders": RENDERS}


def best_of(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Return step, training seconds, PSNR and SSIM of the evaluation with the highest PSNR."""
    scored = [(psnr, row) for row in rows if (psnr := row.get("psnr")) is not None]
    valid = [(psnr, row) for psnr, row in scored if not math.isnan(psnr)]
    if not valid:
        return None
    _, best = max(valid, key=lambda pair: pair[0])
    return {name: best.get(name) for name in ("step", "train_seconds", "psnr", "ssim")}


def _finite(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


_NULL = "-"


def final_table(result: EvaluationResult | None, totals: Totals) -> str:
    """Return the table of metrics, overall and per regime, and a line about the cost of the run."""
    lines = () if result is None else metric_lines(result)
    return "\n".join([*lines, cost_line(totals)])


def metric_lines(result: EvaluationResult) -> list[str]:
    """Return the metrics overall and per regime, and the reason for each missing metric."""
    reasons = (f"no {metric}: {reason}" for metric, reason in _shown(result))
    return [*_aligned(_rows(result)), *reasons]


def cost_line(totals: Totals) -> str:
    """Return training seconds, steps, rendered views, primitives and memory in one line."""
    peak = totals.peak_memory_mib
    memory = "" if peak is None else f", peak memory {peak:,.0f} MiB"
    return (
        f"{totals.train_seconds:,.1f} s training, {totals.step:,} steps, "
        f"{totals.views:,} views rendered, {totals.backward_passes:,} backward passes, "
        f"{totals.primitives:,} primitives{memory}"
    )


def _rows(result: EvaluationResult) -> list[tuple[str, ...]]:
    # Leave out metrics that are not defined for the views.
    shown = [
        figure for figure in result.figures if result.reasons.get(figure.name) != figure.undefined
    ]
    header = ("", "views", *(figure.label for figure in shown))
    rows = [header, _row("overall", result.overall, shown)]
    # Leave out a single regime, because its row would be equal to the first row.
    if len(result.regimes) > 1:
        rows += [_row(name, means, shown) for name, means in result.regimes.items()]
    return rows


def _row(name: str, means: Means, figures: Sequence[Figure]) -> tuple[str, ...]:
    cells = (_number(means[figure.name], figure.form) for figure in figures)
    return (name, str(means.views), *cells)


def _number(value: float | None, form: str) -> str:
    return _NULL if value is None else format(value, form)


def _shown(result: EvaluationResult) -> list[tuple[str, str]]:
    """Return pairs (name, reason) of missing metrics; omit metrics without values by regime."""
    reported_by_regime = [figure.name for figure in result.figures if figure.per_regime]
    return [(name, why) for name, why in result.reasons.items() if name in reported_by_regime]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines
