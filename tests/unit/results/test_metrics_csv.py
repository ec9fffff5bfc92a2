"""metrics.csv: columns, exact numbers, and continuing after a resume or a crash."""

import errno
from dataclasses import replace
from io import FileIO
from pathlib import Path

import pytest
from support.figures import columns

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.metrics_csv import (
    MetricsCsv,
    metrics_row,
    read_metrics,
)

HEADER = (
    "step,views,backward_passes,train_seconds,cpu_seconds,psnr,ssim,ssim_skimage,lpips,"
    "psnr_far,ssim_far,psnr_near,ssim_near,primitives,peak_memory_mib,loss"
)


def test_the_metrics_table_has_columns_for_every_regime():
    assert ",".join(columns(["near", "far"])) == HEADER


def test_a_row_is_written_in_the_documented_format(tmp_path: Path, result, totals):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    table.append(metrics_row(totals, result))
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines == [
        HEADER,
        "700,1400,1400,38.21,36.75,24.0,0.7000000000000001,0.7833333333333333,,"
        "30.0,0.9,21.0,0.6,111785,1523.0,0.06123456789012346",
    ]


def test_numbers_are_read_back_exactly(tmp_path: Path, result, totals):
    row = metrics_row(totals, result)
    MetricsCsv.create(tmp_path, columns(["near", "far"])).append(row)
    assert read_metrics(tmp_path) == (row,)
    assert row["lpips"] is None


def test_the_metrics_of_a_run_without_held_out_views_are_empty(tmp_path: Path, empty, totals):
    table = MetricsCsv.create(tmp_path, columns([]))
    table.append(metrics_row(totals, empty))
    assert (
        (tmp_path / "metrics.csv")
        .read_text()
        .splitlines()[1]
        .startswith("700,1400,1400,38.21,36.75,,,,,")
    )


def test_an_unknown_column_is_a_programming_error(tmp_path: Path):
    with pytest.raises(ValueError, match="typo"):
        MetricsCsv.create(tmp_path, columns([])).append({"typo": 1})


def test_resuming_removes_rows_after_the_step(tmp_path: Path, result, totals):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    for step in (100, 200, 300):
        table.append(metrics_row(replace(totals, step=step), result))
    resumed = MetricsCsv.resume(tmp_path, columns(["near", "far"]), step=200)
    resumed.append(metrics_row(replace(totals, step=300, loss=0.5), result))
    assert [(row["step"], row["loss"]) for row in read_metrics(tmp_path)] == [
        (100, totals.loss),
        (200, totals.loss),
        (300, 0.5),
    ]


def test_resuming_removes_a_truncated_row(tmp_path: Path, result, totals):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    table.append(metrics_row(replace(totals, step=100), result))
    with table.path.open("a") as file:
        file.write("200,400,40")
    resumed = MetricsCsv.resume(tmp_path, columns(["near", "far"]), step=200)
    resumed.append(metrics_row(replace(totals, step=300), result))
    assert [row["step"] for row in read_metrics(tmp_path)] == [100, 300]


def test_resuming_without_a_table_creates_a_table(tmp_path: Path):
    MetricsCsv.resume(tmp_path, columns([]), step=5)
    assert read_metrics(tmp_path) == ()


@pytest.mark.parametrize("text", ["", "step,psnr\n1,2\n"])
def test_the_metrics_table_of_another_run_is_refused(tmp_path: Path, text: str):
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(UserError, match="another run"):
        MetricsCsv.resume(tmp_path, columns(["near", "far"]), step=5)
    assert (tmp_path / "metrics.csv").read_text() == text


def test_regime_names_with_commas_are_read_back(tmp_path: Path, totals, result):
    regimes = {'a,"b"': result.regimes["far"], "c": result.regimes["near"]}
    odd = replace(result, regimes=regimes)
    MetricsCsv.create(tmp_path, columns(list(regimes))).append(metrics_row(totals, odd))
    assert read_metrics(tmp_path)[0]['psnr_a,"b"'] == 30.0


@pytest.mark.parametrize(
    "content",
    [
        b"step,psnr,ssim\n1,2\n",
        b"step,psnr,ssim\na,b,c\n",
        b"step,psnr,ssim\n1,1_0,3\n",
        "step,psnr,ssim\n1,٣,3\n".encode(),
        b"step,psnr,psnr\n1,2,3\n",
        b"step,psnr,ssim\n1,2," + b"9" * 5000 + b"\n",
        b'step,psnr,ssim\n1,"2\n',
        b"step,psnr,ssim\n1,2,\xff\n",
        b"step,psnr,ssim\n1,2," + b"3" * 200_000 + b"\n",
        b"step,psnr,ssim\n1,2,3\n\n",
        b"step,psnr,ssim\n-1,2,3\n",
        b"step,psnr,ssim\n1.5,2,3\n",
        b"step,psnr,ssim\nnan,2,3\n",
    ],
)
def test_unreadable_tables_are_reported_with_a_remedy(tmp_path: Path, content: bytes):
    (tmp_path / "metrics.csv").write_bytes(content)
    with pytest.raises(UserError, match=r"metrics\.csv(?s:.*)to do"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("cell", ["x", "1e", "٣", "inf3"])
@pytest.mark.parametrize("column", ["step", "psnr"])
def test_a_damaged_table_is_refused_on_resume(
    tmp_path: Path, totals, result, cell: str, column: str
):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    table.append({**metrics_row(replace(totals, step=100), result), column: cell})
    before = table.path.read_bytes()
    with pytest.raises(UserError, match=r"metrics\.csv cannot be read"):
        MetricsCsv.resume(tmp_path, columns(["near", "far"]), step=200)
    assert table.path.read_bytes() == before


def test_infinite_and_nan_metrics_are_read(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text("step,psnr,ssim\n1,inf,nan\n")
    (row,) = read_metrics(tmp_path)
    assert row["psnr"] == float("inf")
    assert row["ssim"] != row["ssim"]


def test_a_missing_table_is_reported(tmp_path: Path):
    with pytest.raises(UserError, match=r"does not contain metrics\.csv"):
        read_metrics(tmp_path)


def test_a_row_truncated_within_its_last_number_is_removed(tmp_path: Path, result, totals):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    table.append(metrics_row(totals, result))
    whole = table.path.read_bytes()
    table.append(metrics_row(replace(totals, step=800), result))
    cut = table.path.read_bytes()[:-3]
    assert cut.count(b",") == table.path.read_bytes().count(b",")
    table.path.write_bytes(cut)
    assert [row["step"] for row in read_metrics(tmp_path)] == [totals.step]
    resumed = MetricsCsv.resume(tmp_path, columns(["near", "far"]), step=800)
    assert resumed.path.read_bytes() == whole


class Nearly:
    """A file on a disk that is full after some bytes."""

    def __init__(self, file: FileIO, room: int) -> None:
        self._file, self._room = file, room

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()

    def write(self, content: bytes) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self._file.write(bytes(content)[: self._room])
        self._room -= written
        return written

    def __getattr__(self, name: str):
        return getattr(self._file, name)


@pytest.mark.parametrize("room", [0, 1, 20, 10**6])
def test_a_full_disk_leaves_no_partial_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int, *, result, totals
):
    table = MetricsCsv.create(tmp_path, columns(["near", "far"]))
    table.append(metrics_row(totals, result))
    before = table.path.read_bytes()
    opened = Path.open
    monkeypatch.setattr(Path, "open", lambda *a, **k: Nearly(opened(*a, **k), room))
    if room < 10**6:
        with pytest.raises(UserError, match="not enough disk space"):
            table.append(metrics_row(totals, result))
        assert table.path.read_bytes() == before
    else:
        table.append(metrics_row(totals, result))
        assert table.path.read_bytes().startswith(before)
