"""The results of a diagnosis: CSV files, a figure, and some lines for the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path

from crossgrad_core.commands import (
    UserError,
    parse_number,
    read_rows,
    write_atomically,
    write_table,
)
from crossgrad_plugins.diagnostics.exposure import SceneExposure
from crossgrad_plugins.diagnostics.table import ALL, Row, rows_of, touched

PROBES = "diagnostics.csv"
CAMERAS = "cameras.csv"
GROUPINGS = "groupings.csv"
PICTURE = "diagnostics.png"
EXPOSURE = "exposure.csv"
EXPOSURE_PICTURE = "exposure.png"
#: All files of a report.
FILES = (PROBES, CAMERAS, GROUPINGS, PICTURE, EXPOSURE, EXPOSURE_PICTURE)


@dataclass(frozen=True)
class Report:
    """The complete results of a diagnosis.

    Attributes:
        scene: Name of the scene.
        title: Title of the report, with scene and model.
        probes: Rows of all probes, as returned by `table`, one after the other.
        cameras: Rows as returned by `camera_rows`.
        groupings: Rows as returned by `grouping_rows`, for the last probe.
        notes: Notes for the reader of the report.
        failure: The reason why training failed, or None.
        exposure: The exposure of the photos, or None if it was not measured.
    """

    scene: str
    title: str
    probes: Sequence[Row]
    cameras: Sequence[Row]
    groupings: Sequence[Row]
    notes: Sequence[str] = ()
    failure: str | None = None
    exposure: SceneExposure | None = None

    def write(self, folder: Path) -> None:
        """Write the CSV files and the figures.

        Raises:
            UserError: The disk is full, or the folder is read-only.
        """
        from crossgrad_plugins.diagnostics.figure import draw

        write_table(folder / PROBES, self.probes)
        write_table(folder / CAMERAS, self.cameras)
        write_table(folder / GROUPINGS, self.groupings)
        write_atomically(folder / PICTURE, draw(self.title, self.probes, self.cameras))
        if self.exposure is not None:
            self._write_exposure(folder, self.exposure)

    def _write_exposure(self, folder: Path, exposure: SceneExposure) -> None:
        from crossgrad_plugins.diagnostics.figure import draw_exposure

        write_table(folder / EXPOSURE, exposure.rows)
        write_atomically(folder / EXPOSURE_PICTURE, draw_exposure(self.scene, exposure))

    def lines(self) -> list[str]:
        """Return the lines of the report for a terminal."""
        parts = (
            [f"scene: {self.scene}", *self.notes],
            _camera_lines(self.cameras),
            [] if self.exposure is None else self.exposure.lines(),
            self._blocks(),
            _grouping_lines(self.groupings),
        )
        return [line for section in parts if section for line in ("", *section)][1:]

    def _blocks(self) -> list[str]:
        last = max(int(row["step"]) for row in self.probes)
        now = [row for row in self.probes if row["step"] == last]
        first = now[0]
        lines = [
            f"step {last}, {first['near_views']} near and {first['far_views']} far views by "
            f"grouping {first['grouping']}; intervals 95 %"
        ]
        for metric in dict.fromkeys(str(row["metric"]) for row in now):
            lines += ["", f"{metric} metric", _HEADER]
            lines += [_block_line(row) for row in touched(rows_of(now, metric))]
        return lines


_HEADER = (
    f"{'block':<16}{'conflict':>9}{'near/far':>9}{'sigma_b2/sigma_w2':>26}"
    f"{'noise scale':>13}{'exponent':>22}"
)


def _block_line(row: Row) -> str:
    conflict = _figure(100.0 * float(row["conflict_rate"]), ".0f") + " %"
    rho = _with_interval(row, "rho", ".2g")
    exponent = _with_interval(row, "exponent_radial", ".1f")
    name = str(row["block"])
    return (
        f"{name if name != ALL else '(all)':<16}{conflict:>9}"
        f"{_figure(float(row['ratio_of_means']), '.2f'):>9}{rho:>26}"
        f"{_figure(float(row['noise_scale']), '.3g'):>13}{exponent:>22}"
    )


def _with_interval(row: Row, name: str, form: str) -> str:
    low, high = float(row[f"{name}_low"]), float(row[f"{name}_high"])
    ends = "" if isnan(low) else f" [{_figure(low, form)}, {_figure(high, form)}]"
    return _figure(float(row[name]), form) + ends


def _camera_lines(rows: Sequence[Row]) -> list[str]:
    lines = ["Sarle's bimodality (finite-sample, population form; uniform 0.56, normal 0.33)"]
    for row in rows:
        figures = (
            f"{_figure(float(row['bimodality_sample']), '.3f')}, "
            f"{_figure(float(row['bimodality_population']), '.3f')}, n = {row['views']}"
        )
        variance = float(row["relative_variance"])
        spread = "" if isnan(variance) else f"; Var(r)/mean(r)^2 = {variance:.3g}"
        note = f" ({row['note']})" if row["note"] else ""
        lines.append(f"  {row['quantity']}: {figures}{spread}{note}")
    return lines


def _grouping_lines(rows: Sequence[Row]) -> list[str]:
    """Return the first block's statistics for each grouping.

    These statistics depend on which views are near and which are far.
    """
    lines = ["the same probe by grouping, plain metric"]
    for name in dict.fromkeys(str(row["grouping"]) for row in rows):
        first = next(row for row in rows if row["grouping"] == name)
        if first["note"]:
            lines.append(f"  {name}: {first['note']}")
            continue
        lines.append(
            f"  {name} ({first['near_cameras']} near, {first['far_cameras']} far): "
            f"{first['block']} near/far {_figure(float(first['ratio_of_means']), '.2f')}, "
            f"sigma_b2/sigma_w2 {_figure(float(first['rho']), '.2g')}, blocks in conflict per pair "
            f"{_figure(100.0 * float(first['per_pair_conflict']), '.0f')} %"
        )
    return lines


def _figure(value: float, form: str) -> str:
    # Adding zero after rounding changes -0.00 to 0.00.
    return "-" if isnan(value) else format(float(format(value, form)) + 0.0, form)


def read_probes(path: Path) -> list[Row]:
    """Read the rows of probes from a file that `write_table` wrote; empty cells become NaN.

    If the file does not exist, there are no rows.

    Raises:
        UserError: The file cannot be read, or a row lacks cells or a step number.
    """
    if not path.is_file():
        return []
    todo = "remove the file; a new file then starts without the rows of earlier steps"
    header, *lines = read_rows(path, "the table of probes", todo) or [[]]
    rows: list[Row] = [dict(zip(header, map(_value, line), strict=False)) for line in lines]
    for line, row in zip(lines, rows, strict=True):
        if len(row) != len(line) or len(row) != len(header) or not isinstance(row.get("step"), int):
            raise UserError(
                "the table of probes cannot be read",
                where=path,
                expected=f"{len(header)} cells, including a step",
                found=",".join(line),
                todo=todo,
            )
    return rows


def _value(cell: str) -> str | int | float:
    if cell == "":
        return float("nan")
    try:
        return parse_number(cell)
    except ValueError:
        return cell
