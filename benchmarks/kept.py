"""Pack the tables of a sweep into one small file, or unpack such a file.

    python benchmarks/kept.py pack runs/sweeps/GRID benchmarks/results/GRID.tar.xz
    python benchmarks/kept.py unpack benchmarks/results/GRID.tar.xz runs/sweeps/GRID

The file contains configurations, summaries, evaluations and held-out metrics of finished runs, but
no models and no pictures. `crossgrad compare` can read the unpacked runs. `crossgrad sweep`
continues with the missing runs, also on another machine. Packing a sweep twice gives equal files.
"""

import argparse
import csv
import io
import sys
import tarfile
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from crossgrad_core.commands import UserError, read_rows, summary_of, write_atomically
from crossgrad_core.system.text_files import csv_bytes

#: The table of a sweep. The table assigns a configuration to each run.
TABLE = "runs.csv"
#: Rows of this table; the first row is the header.
Rows: TypeAlias = Sequence[Sequence[str]]

#: Files of a run that are packed. The second line lists files of the observer `diagnostics`, and
#: the last line lists files of distances.py.
FILES = (
    *("config.yaml", "summary.json", "metrics.csv", "per_view.csv", "scene.json"),
    *("diagnostics.csv", "cameras.csv", "groupings.csv"),
    *("per_view*_on_*.csv", "per_view*_on_*.json"),
)


def pack(sweep: Path, archive: Path) -> int:
    """Pack the finished runs of a sweep.

    Args:
        sweep: Folder of the sweep.
        archive: The file to write or replace.

    Returns:
        The number of packed runs.

    Raises:
        UserError: The folder is not a sweep, no run has finished, or a run has no row in the table
            of the sweep.
    """
    runs = [each for each in sorted((sweep / "runs").glob("*")) if _is_finished(each)]
    if not runs or not (sweep / TABLE).is_file():
        raise UserError(
            "nothing to keep",
            where=sweep,
            expected="the folder of a sweep with finished runs and their table runs.csv",
            found=f"{len(runs)} finished runs" if runs else "none",
            todo="name the folder that `crossgrad sweep` printed",
        )
    _check_labelled(sweep, [run.name for run in runs])
    archive.parent.mkdir(parents=True, exist_ok=True)
    part = archive.with_name(f"{archive.name}.part")
    with tarfile.open(part, "w:xz", preset=9) as file:
        for path in _kept(sweep, runs):
            file.add(path, path.relative_to(sweep).as_posix(), filter=_without_owner)
    part.replace(archive)
    return len(runs)


def _check_labelled(sweep: Path, runs: Iterable[str]) -> None:
    """Refuse runs without a row in the table, because their configuration would be lost."""
    known = {row[0] for row in _table(sweep) if row}
    if without := [run for run in runs if run not in known]:
        raise UserError(
            "runs are not in the table of the sweep",
            where=sweep / TABLE,
            expected="a row for each folder below runs/",
            found=f"no row for {len(without)} runs: {', '.join(without[:5])}",
            todo="unpack the archive of these runs again, or move their folders away",
        )


def _table(sweep: Path) -> Rows:
    return read_rows(sweep / TABLE, "the table of the sweep", "restore it, or remove it")


def _is_finished(run: Path) -> bool:
    return (summary_of(run) or {}).get("status") == "finished"


def _kept(sweep: Path, runs: list[Path]) -> Iterator[Path]:
    yield sweep / TABLE
    # Sort the files by name. Similar files are then adjacent, so that they are compressed to a
    # third of the size.
    for name in FILES:
        yield from (path for run in runs for path in sorted(run.glob(name)))


def _without_owner(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = entry.mtime = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o644
    return entry


def unpack(archive: Path, sweep: Path) -> int:
    """Add the packed runs to the folder of a sweep. Existing runs are not changed.

    New rows are appended to the table of the sweep, even if the run itself already exists.

    Returns:
        The number of added runs.

    Raises:
        UserError: The two tables of runs have different columns.
    """
    with tarfile.open(archive, "r:xz") as file:
        entries = file.getmembers()
        here = {path.name for path in (sweep / "runs").glob("*")}
        kept = {_run_of(entry) for entry in entries} - {""}
        table = _merged(sweep, _rows_of(file), kept)
        wanted = [entry for entry in entries if _run_of(entry) in kept - here]
        file.extractall(sweep, wanted, filter="data")
    if table is not None:
        write_atomically(sweep / TABLE, csv_bytes(table))
    return len(kept - here)


def _rows_of(file: tarfile.TarFile) -> Rows:
    """Return the table of runs in a file; no rows if the file has no table."""
    content = file.extractfile(TABLE) if TABLE in file.getnames() else None
    return [] if content is None else list(csv.reader(io.TextIOWrapper(content, "utf-8")))


def _merged(sweep: Path, rows: Rows, runs: Container[str]) -> Rows | None:
    """Return a sweep's table with further rows; None if it does not change."""
    own = _table(sweep) if (sweep / TABLE).exists() else []
    if not own or not rows:
        return rows or None
    if list(own[0]) != list(rows[0]):
        raise UserError(
            "the tables of runs have different columns",
            where=sweep / TABLE,
            expected=", ".join(rows[0]),
            found=", ".join(own[0]),
            todo="unpack into a separate folder",
        )
    new = [row for row in rows[1:] if row not in own and row and row[0] in runs]
    return [*own, *new] if new else None


def _run_of(entry: tarfile.TarInfo) -> str:
    return entry.name.split("/")[1] if "/" in entry.name else ""


def main() -> None:
    """Pack or unpack."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    given = parser.parse_args()
    try:
        done = {"pack": pack, "unpack": unpack}[given.what](given.source, given.target)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"{given.target}: {done} runs")


if __name__ == "__main__":
    main()
