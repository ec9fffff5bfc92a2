"""The tables of a sweep, packed into one small file to be kept, and back.

    python benchmarks/kept.py pack runs/sweeps/GRID benchmarks/results/GRID.tar.xz
    python benchmarks/kept.py unpack benchmarks/results/GRID.tar.xz runs/sweeps/GRID

Configurations, summaries, evaluations and held-out views of finished runs are kept, models and
pictures are not. `crossgrad compare` reads what was unpacked, and `crossgrad sweep` goes on with
what is missing: on another machine, too. The same sweep gives the same file.
"""

import argparse
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

from crossgrad_core.commands import UserError, summary_of

#: Files of a run that are kept; those of the second line are of the observer `diagnostics`, the
#: last ones of views elsewhere (distances.py).
FILES = (
    *("config.yaml", "summary.json", "metrics.csv", "per_view.csv", "scene.json"),
    *("diagnostics.csv", "cameras.csv", "groupings.csv"),
    "per_view*_on_*.csv",
)


def pack(sweep: Path, archive: Path) -> int:
    """Packs the finished runs of a sweep.

    Args:
        sweep: Its folder.
        archive: The file that is written, or replaced.

    Returns:
        How many runs it holds.

    Raises:
        UserError: The folder is no sweep, or none of its runs has finished.
    """
    runs = [each for each in sorted((sweep / "runs").glob("*")) if _is_finished(each)]
    if not runs or not (sweep / "runs.csv").is_file():
        raise UserError(
            "nothing to keep",
            where=sweep,
            expected="the folder of a sweep, with runs that finished and their table runs.csv",
            found=f"{len(runs)} finished runs" if runs else "none",
            todo="name the folder that `crossgrad sweep` printed",
        )
    archive.parent.mkdir(parents=True, exist_ok=True)
    part = archive.with_name(f"{archive.name}.part")
    with tarfile.open(part, "w:xz", preset=9) as file:
        for path in _kept(sweep, runs):
            file.add(path, path.relative_to(sweep).as_posix(), filter=_without_owner)
    part.replace(archive)
    return len(runs)


def _is_finished(run: Path) -> bool:
    return (summary_of(run) or {}).get("status") == "finished"


def _kept(sweep: Path, runs: list[Path]) -> Iterator[Path]:
    yield sweep / "runs.csv"
    # File by file, so that what is alike in all runs lies close together: a third of the size.
    for name in FILES:
        yield from (path for run in runs for path in sorted(run.glob(name)))


def _without_owner(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = entry.mtime = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o644
    return entry


def unpack(archive: Path, sweep: Path) -> int:
    """Adds the runs of a file to the folder of a sweep; runs that are there stay as they are.

    Returns:
        How many runs were added.
    """
    with tarfile.open(archive, "r:xz") as file:
        entries = file.getmembers()
        here = {path.name for path in (sweep / "runs").glob("*")}
        new = {entry.name.split("/")[1] for entry in entries if "/" in entry.name} - here
        wanted = [entry for entry in entries if _run_of(entry) in new]
        if not (sweep / "runs.csv").exists():
            wanted += [entry for entry in entries if entry.name == "runs.csv"]
        file.extractall(sweep, wanted, filter="data")
    return len(new)


def _run_of(entry: tarfile.TarInfo) -> str:
    return entry.name.split("/")[1] if "/" in entry.name else ""


def main() -> None:
    """Packs or unpacks."""
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
