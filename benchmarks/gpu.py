"""Measure step times, memory and quality on a GPU.

Finished measurements are stored and not repeated.

    python benchmarks/gpu.py SCENE                                 # all of it
    python benchmarks/gpu.py SCENE --gsplat-examples gsplat/examples
    python benchmarks/gpu.py SCENE --only sizes-gsplat steps-gsplat

Part `sizes` takes steps on a random cloud of visible Gaussians, with photos of one megapixel. Part
`steps` takes steps on SCENE with every rasterizer that runs on the GPU, every backbone, K and
operator. Both parts measure steps during density control and between two edits, with SH degree 3,
in this process. Seconds are wall time; the GPU is idle at the start and at the end of a
measurement. Part `long` trains SCENE for 30,000 steps with the published settings, in separate
processes. Its table rows show the run after 7,000, 15,000 and all steps. Part `usual` trains SCENE
with the default settings of `crossgrad run`, for several lengths. If the folder of gsplat's
examples is given, gsplat's own trainer also trains SCENE for as many steps as `long`. gsplat's
trainer holds out every 8th photo of the scene, and crossgrad holds out every 8th photo of each
folder. Runs and tables (gpu.csv, gpu_curves.csv, gpu.md) are written to the folder of `--out`.
After an interruption, the same command continues. Without a GPU the exit code is 2.
"""

import argparse
import csv
import gc
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch
from _gpu_cases import PIXELS, Case, cases, is_chosen, stops
from _gsplat_trainer import trained
from _machine import code, facts
from scale import STEP, Cell, Run

from crossgrad_core.commands import assemble, begin, configured, read_scene
from crossgrad_core.run.results.reading import read_run
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.state import RollbackGuard
from crossgrad_core.training.views import target_at

if TYPE_CHECKING:
    from crossgrad_core.training.setup import Setup
    from crossgrad_core.training.state import TrainState

#: Name of gsplat's trainer in the column of rasterizers.
THEIRS = "gsplat's trainer"
COLUMNS = (
    "part", "rasterizer", "backbone", "views", "operator", "steps", "ms_per_step",
    "views_per_second", "train_seconds", "psnr", "primitives", "peak_mib", "note", "gpu", "torch",
    "code", "date",
)  # fmt: skip
Row = dict[str, Any]


class Short:
    """Measures cases in this process, and stores the results in a file.

    Args:
        scene: Path of SCENE.
        kept: The file, with one JSON line per case.
        place: Scene, GPU and commit of the measurements; stored results with other values are
            ignored.
    """

    def __init__(self, scene: Path, kept: Path, place: str) -> None:
        self.scene, self._kept, self._place = scene, kept, place
        self._known: dict[str, Row] = {}
        for line in kept.read_text(encoding="utf-8").splitlines() if kept.is_file() else []:
            # Skip the last line if it is truncated.
            with suppress(json.JSONDecodeError, KeyError):
                row = json.loads(line)
                self._known[row.pop("case")] = row

    def known(self, case: Case) -> Row | None:
        """Return the stored results of a case, or None."""
        return self._known.get(self._key(case))

    def row(self, case: Case) -> Row:
        """Return the results of a case, or the reason of a failure; failures are not stored."""
        if (known := self.known(case)) is not None:
            return known
        try:
            found = self._measured(case)
        except Exception as error:
            # A failed case must not end the program, unless the GPU cannot be used any more.
            torch.cuda.synchronize()
            return _row(case, {"note": " ".join(f"{type(error).__name__}: {error}".split())})
        row = _row(case, found)
        with self._kept.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"case": self._key(case), **row}) + "\n")
        return row

    def _key(self, case: Case) -> str:
        return f"{case.name}, {self._place}"

    def _measured(self, case: Case) -> Row:
        gc.collect()
        torch.cuda.empty_cache()
        before = torch.cuda.memory_allocated()
        setup, state = self._begun(case)
        setup.rasterizer.self_test("cuda")
        # Keep a copy of parameters and moments for a rollback, as a run does.
        guard = RollbackGuard(state)
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        seconds = steady(setup, state, case.steps)
        del guard
        machine = facts()
        return {
            "ms_per_step": round(1e3 * seconds / case.steps, 2),
            "views_per_second": round(case.steps * case.views / seconds, 1),
            "primitives": state.primitives(setup),
            "peak_mib": round((torch.cuda.max_memory_allocated() - before) / 2**20, 1),
            "gpu": torch.cuda.get_device_name(),
            "torch": machine["torch"],
            "code": code(),
            "date": machine["date"],
        }

    def _begun(self, case: Case) -> "tuple[Setup, TrainState]":
        if case.gaussians:
            cell = Cell(
                case.gaussians, case.gaussians, PIXELS, views=case.views, operator=case.operator
            )
            run = Run(cell, device="cuda", rasterizer={"name": case.rasterizer})
            return run.setup, run.state
        config = configured(case.config(self.scene))
        scene, reader = read_scene(config)
        setup = assemble(config, scene, reader)
        state = begin(setup)
        state.step = STEP
        return setup, state


def steady(setup: "Setup", state: "TrainState", steps: int) -> float:
    """Return the seconds of `steps` steps, after all photos and kernels are loaded."""
    for index in range(len(setup.train_views)):
        target_at(setup, state, index, 1.0)
    for _ in range(max(3, steps // 6)):
        timed_step(setup, state)
    torch.cuda.synchronize()
    start = perf_counter()
    for _ in range(steps):
        timed_step(setup, state)
    torch.cuda.synchronize()
    return perf_counter() - start


def finished(folder: Path) -> Path | None:
    """Return the finished run of a case, or None."""
    for summary in sorted(folder.glob("*/summary.json")):
        if json.loads(summary.read_text(encoding="utf-8")).get("status") == "finished":
            return summary.parent
    return None


def measured(case: Case, scene: Path, out: Path) -> tuple[Path | None, str]:
    """Train the case's run if it is missing.

    Return the folder of the run and an empty text. If training failed, return None and the reason.
    """
    folder = out / "runs" / case.name
    if (run := finished(folder)) is not None:
        return run, ""
    refused = folder / "refused.txt"
    if refused.is_file():
        return None, refused.read_text(encoding="utf-8")
    place = folder / str(len(list(folder.glob("*"))) + 1)
    ended = subprocess.run(case.command(scene, place), capture_output=True, text=True, check=False)
    if ended.returncode == 0:
        return place, ""
    why = " ".join(ended.stderr.split())
    if ended.returncode == 2:
        # Store the reason if the input is invalid, because a repetition would fail again. Other
        # failures are tried again by the next command.
        folder.mkdir(parents=True, exist_ok=True)
        refused.write_text(why, encoding="utf-8")
    return None, why


def _row(case: Case, found: Row) -> Row:
    own = {name: value for name, value in asdict(case).items() if name in COLUMNS}
    own["primitives"] = case.gaussians or ""
    return {**dict.fromkeys(COLUMNS, ""), **own, **found, "note": found.get("note", "")[:300]}


def rows_of(case: Case, run: Path | None, why: str) -> Iterator[Row]:
    """Yield the results of a long run at its stops, or the reason why they are missing."""
    if run is None:
        yield _row(case, {"note": why})
        return
    results = read_run(run)
    summary: Mapping[str, Any] = results.summary or {}
    environment = summary["environment"]
    own = {
        "gpu": environment["gpu"],
        "torch": environment["packages"]["torch"],
        "code": environment["commit"] or environment["crossgrad"],
        "date": _written(run / "summary.json"),
    }
    for row in results.rows:
        if row["step"] in stops(case.steps):
            found = _paced(row["step"], case.views, row["train_seconds"]) | {
                "psnr": _rounded(row.get("psnr")),
                "primitives": row["primitives"],
            }
            if row["step"] == case.steps:
                found["peak_mib"] = _rounded(summary.get("peak_memory_mib"))
            yield _row(case, own | found)


def _paced(steps: int, views: int, seconds: float) -> Row:
    return {
        "steps": steps,
        "ms_per_step": round(1e3 * seconds / steps, 2),
        "views_per_second": round(steps * views / seconds, 1),
        "train_seconds": round(seconds, 2),
    }


def theirs(
    examples: Path, scene: Path, out: Path, steps: int, limit: float | None = None
) -> Iterator[Row]:
    """Yield the rows of gsplat's own trainer."""
    own: Row = {"part": "long", "rasterizer": THEIRS, "backbone": "vanilla", "views": 1}
    own = {**dict.fromkeys(COLUMNS, ""), **own, "operator": "sum"}
    reached, why = trained(examples, scene, out / "runs", stops(steps), limit)
    for stop in reached:
        found = {
            "psnr": _rounded(stop.psnr),
            "primitives": stop.gaussians,
            "peak_mib": round(stop.mib, 1),
            "note": "photos, split, loss and seconds of gsplat's trainer",
            "date": _written(stop.file),
        }
        yield own | _paced(stop.step, 1, stop.seconds) | found
    if why:
        yield own | {"steps": steps, "note": why}


def curve_rows(case: Case, run: Path | None) -> Iterator[Row]:
    """Yield step, training seconds and PSNR of every evaluation of a long run."""
    for row in [] if run is None else read_run(run).rows:
        shown = {name: row.get(name) for name in ("step", "train_seconds", "psnr")}
        yield {"run": case.name, **shown}


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Row]) -> None:
    """Write a table."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows(rows)


def as_markdown(rows: Iterable[Row], machine: str) -> str:
    """Return the table as Markdown."""
    shown = COLUMNS[: COLUMNS.index("gpu")]
    lines = [
        "# On a GPU",
        "",
        f"`python benchmarks/gpu.py`, {machine}.",
        "",
        f"| {' | '.join(name.replace('_', ' ') for name in shown)} |",
        f"|{'---|' * len(shown)}",
    ]
    cells = ([str(row[name]).replace("|", "/") for name in shown] for row in rows)
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in cells), ""])


def _written(path: Path) -> str:
    """Return the time at which a file was written, in UTC."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")


def _rounded(value: float | None) -> float | str:
    return "" if value is None else round(float(value), 3)


def case_rows(case: Case, short: Short, out: Path, *, new: bool) -> tuple[list[Row], list[Row]]:
    """Return the table rows of a case and of its curve; none if it was not measured."""
    if case.part not in {"long", "usual"}:
        row = short.row(case) if new else short.known(case)
        return ([] if row is None else [row]), []
    if not new and finished(out / "runs" / case.name) is None:
        return [], []
    run, why = measured(case, short.scene, out)
    return list(rows_of(case, run, why)), list(curve_rows(case, run))


def run_all(arguments: argparse.Namespace, gpu: str) -> None:
    """Measure the missing cases, and write the tables after every case."""
    out, scene = arguments.out.resolve(), arguments.scene.resolve()
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    curves: list[Row] = []
    machine = facts()
    versions = f"torch {machine['torch']}, {machine['date']}, commit {code()}"
    described = f"{gpu}, {machine['cpu']}, {versions}"

    def write(row: Row) -> None:
        rows.append(row)
        print(json.dumps({name: value for name, value in row.items() if value != ""}), flush=True)
        write_csv(out / "gpu.csv", COLUMNS, rows)
        write_csv(out / "gpu_curves.csv", ("run", "step", "train_seconds", "psnr"), curves)
        (out / "gpu.md").write_text(as_markdown(rows, described), encoding="utf-8")

    short = Short(scene, out / "short.jsonl", f"{scene}, {gpu}, {code()}")
    for case in cases(arguments.steps, arguments.long):
        found, curve = case_rows(case, short, out, new=is_chosen(case, arguments.only))
        curves.extend(curve)
        for row in found:
            write(row)
    if arguments.gsplat_examples is not None:
        examples, limit = arguments.gsplat_examples.resolve(), arguments.trainer_seconds
        for row in theirs(examples, scene, out, arguments.long, limit):
            write(row)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument(
        "--only", nargs="+", metavar="TEXT", help="only cases whose name contains this text"
    )
    parser.add_argument(
        "--steps", type=int, default=60, help="number of measured steps of a short case"
    )
    parser.add_argument("--long", type=int, default=30_000)
    parser.add_argument("--out", type=Path, default=Path("gpu"))
    parser.add_argument("--gsplat-examples", type=Path)
    parser.add_argument(
        "--trainer-seconds", type=float, help="time limit of gsplat's trainer in seconds"
    )
    arguments = parser.parse_args()
    all_cases = list(cases(arguments.steps, arguments.long))
    if missing := [t for t in arguments.only or () if not any(t in c.name for c in all_cases)]:
        names = ", ".join(case.name for case in all_cases)
        print(f"no case has {missing[0]!r} in its name: {names}", file=sys.stderr)
        sys.exit(2)
    if not torch.cuda.is_available():
        print(f"torch {torch.__version__} sees no GPU: nothing is measured", file=sys.stderr)
        sys.exit(2)
    run_all(arguments, torch.cuda.get_device_name())


if __name__ == "__main__":
    main()
