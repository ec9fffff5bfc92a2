"""What a run wrote and reads again: metrics.csv, tables of diagnostics, summary.json."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from crossgrad_core.contract.figure import Figure
from crossgrad_core.errors import UserError
from crossgrad_core.run.results import metrics_csv, summary
from crossgrad_core.run.results.metrics_csv import MetricsCsv, read_metrics
from crossgrad_core.run.results.summary import read_summary
from crossgrad_core.system import text_files
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.diagnostics import report
from crossgrad_plugins.diagnostics.report import read_probes

_METRICS, _SUMMARY, _TABLE = metrics_csv.FILE, summary.FILE, "table.csv"
_PER_VIEW = metrics_csv.PER_VIEW
_READS_VIEWS = ("read_per_view", "_view", "_unreadable_view")
_REGIMES = ("far", "near")


def _columns() -> tuple[str, ...]:
    names = ("psnr", "ssim", "ssim_skimage", "lpips")
    figures = [Figure(name, name, per_regime=name in {"psnr", "ssim"}) for name in names]
    return metrics_csv.columns_for(_REGIMES, figures)


def _metrics() -> bytes:
    columns = _columns()
    rows = [
        [str(100 * (i + 1)), "200", "200", "1.234", "21.5", "0.8", "0.81", *[""] * 8]
        for i in range(2)
    ]
    return "\n".join(",".join(row[: len(columns)]) for row in [list(columns), *rows]).encode()


def _parse_metrics(folder: Path) -> None:
    if not (folder / _METRICS).is_file():
        with suppress(UserError):
            read_metrics(folder)
        MetricsCsv.resume(folder, _columns(), 100)
        return
    rows = read_metrics(folder)
    assert all(row.keys() == rows[0].keys() for row in rows)
    assert all(
        value is None or isinstance(value, int | float) for row in rows for value in row.values()
    )
    MetricsCsv.resume(folder, _columns(), 100)
    again = read_metrics(folder)
    assert all(0 <= (row["step"] or 0) <= 100 for row in again)


def _parse_table(folder: Path) -> None:
    rows = read_probes(folder / _TABLE)
    for row in rows:
        assert all(isinstance(name, str) for name in row)
        assert isinstance(row["step"], int)
        assert all(isinstance(value, str | int | float) for value in row.values())


def _parse_summary(folder: Path) -> None:
    assert isinstance(read_summary(folder), dict)


def _views() -> bytes:
    return b"name,regime,psnr,ssim,psnr_track\na.jpg,far,21.5,0.8,\nb/c.jpg,near,inf,1,20\n"


def _parse_views(folder: Path) -> None:
    views = metrics_csv.read_per_view(folder)
    for view in views:
        assert view.values.keys() == views[0].values.keys()
        assert all(value is None or isinstance(value, float) for value in view.values.values())


def _summaries() -> Sequence[Case]:
    text = b'{"status": "finished", "psnr": 21.5, "notes": ["\xc3\xa4", null, true]}'
    return [{_SUMMARY: text}, {_SUMMARY: b"{}"}]


METRICS = Target(
    name="metrics",
    seeds=lambda: [{_METRICS: _metrics()}, {_METRICS: _metrics() + b"\n"}],
    parse=_parse_metrics,
    parser={
        text_files: ("read_json",),
        metrics_csv: (
            "metrics_row",
            "MetricsCsv.append",
            "_append",
            "write_per_view",
            *_READS_VIEWS,
        ),
    },
    words=(b",", b"\n", b'"', b"step", b"psnr_far", b"nan", b"inf", b"1_0", b"-1"),
    mutators=(matcher(rb"[,\n]([\d.]*)", NUMBERS),),
    writes=frozenset({_METRICS}),
)
TABLE = Target(
    name="diagnostics-table",
    seeds=lambda: [{_TABLE: b"step,block,value\n3,means,0.5\n4,scales,\n"}],
    parse=_parse_table,
    parser={
        text_files: ("read_json",),
        report: tuple(name for name in vars(report) if name not in {"read_probes", "_value"}),
    },
    words=(b",", b"\n", b'"', b"step", b",x", b"nan"),
    mutators=(matcher(rb"[,\n]([\d.]*)", NUMBERS),),
)
SUMMARY = Target(
    name="summary",
    seeds=_summaries,
    parse=_parse_summary,
    parser={
        text_files: ("read_rows", "parse_number"),
        summary: tuple(name for name in vars(summary) if name != "read_summary"),
    },
    words=(b"{", b"}", b"[" * 5000, b"]", b'"a": ', b",", b"NaN", b"Infinity", b"1e999"),
    mutators=(matcher(rb"([\d.]+)", NUMBERS),),
)
PER_VIEW = Target(
    name="per-view",
    seeds=lambda: [{_PER_VIEW: _views()}, {_PER_VIEW: _views() + b"b.jpg,near,,,\n"}],
    parse=_parse_views,
    parser={
        text_files: ("read_json",),
        metrics_csv: tuple(name for name in vars(metrics_csv) if name not in _READS_VIEWS),
    },
    words=(b",", b"\n", b'"', b"name", b"regime", b"psnr", b"nan", b"inf", b"1_0"),
    mutators=(matcher(rb"[,\n]([\d.]*)", NUMBERS),),
)
TARGETS = (METRICS, TABLE, SUMMARY, PER_VIEW)
