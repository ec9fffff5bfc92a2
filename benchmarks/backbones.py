"""Quality of the backbones at equal training time, over seeds and scenes, as a resumable table.

    python benchmarks/backbones.py SCENE [SCENE ...] --seconds 140 --jobs 2

Each run is a process of its own on one core. A finished run adds a line to --rows and is not
repeated; every call ends with the table of all lines in --table. Interrupt it and call it again to
go on, on the same machine: seconds of different machines do not compare.
"""

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean, stdev
from threading import Lock

import numpy as np
from _machine import code, facts

from crossgrad_core.run.results.metrics_csv import read_metrics
from crossgrad_core.run.results.summary import read_summary

RESULTS = Path(__file__).with_name("results")
BACKBONES = ("vanilla", "scaffold", "pixel", "mip", "analytic", "octree")
COLUMNS = (
    *("scene", "backbone", "sampler", "seed", "budget", "seconds", "steps", "views", "primitives"),
    *("psnr", "ssim", "regimes", "ply_loss", "cpu", "date", "code", "curve"),
)
#: Where the curves are read off.
STEPS = (400, 800, 1200, 1600, 2000)
SHARES = (0.25, 0.5, 0.75)
Row = dict[str, str]


@dataclass(frozen=True)
class Job:
    """One run of the table."""

    scene: Path
    backbone: str
    sampler: str
    seed: int

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What identifies its line."""
        return (self.scene.name, self.backbone, self.sampler, str(self.seed))


def run(job: Job, arguments: argparse.Namespace) -> Row:
    """Trains in a process of its own; the line of the result."""
    out = arguments.out / "-".join(job.key)
    command = [sys.executable, "-m", "crossgrad_core", "run", str(job.scene)]
    command += ["--backbone", job.backbone, "--sampler", job.sampler, "--seed", str(job.seed)]
    command += ["--seconds", str(arguments.seconds), "--max-size", str(arguments.max_size)]
    command += ["--threads", "1", "--out", str(out), "-q"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return row_of(job, arguments.seconds, out)


def row_of(job: Job, budget: float, out: Path) -> Row:
    """The line of the finished run in a folder."""
    summary = read_summary(out)
    regimes = {name: round(each["psnr"], 4) for name, each in summary["regimes"].items()}
    loss = (summary["ply"] or {}).get("loss")
    curve = [
        [int(row["step"]), round(float(row["train_seconds"]), 1), round(float(row["psnr"]), 3)]
        for row in read_metrics(out)
    ]
    values = (
        *(*job.key, budget, round(summary["train_seconds"], 1), summary["step"], summary["views"]),
        *(summary["primitives"], round(summary["overall"]["psnr"], 4)),
        *(round(summary["overall"]["ssim"], 5), json.dumps(regimes)),
        *("" if loss is None else round(loss, 3), facts()["cpu"], facts()["date"], code()),
        json.dumps(curve),
    )
    return dict(zip(COLUMNS, map(str, values), strict=True))


def stored(path: Path) -> list[Row]:
    """The lines that are there already."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, row: Row) -> None:
    """Adds a line."""
    new = not path.is_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if new:
            writer.writeheader()
        writer.writerow(row)


def spread(values: Iterable[float], digits: int) -> str:
    """Mean and, over seeds, standard deviation."""
    known = list(values)
    deviation = f" ± {stdev(known):.{digits}f}" if len(known) > 1 else ""
    return f"{mean(known):,.{digits}f}{deviation}"


def line(name: str, rows: Sequence[Row], regimes: Sequence[str]) -> str:
    """One line of the table."""
    split = [json.loads(row["regimes"]) for row in rows]
    cells = [name, str(len(rows)), spread((float(row["psnr"]) for row in rows), 2)]
    cells += [spread((each[regime] for each in split), 2) for regime in regimes]
    cells.append(spread((float(row["ssim"]) for row in rows), 4))
    cells += [spread((float(row[c]) for row in rows), 0) for c in ("seconds", "steps", "views")]
    cells.append(spread((float(row["primitives"]) for row in rows), 0))
    losses = [float(row["ply_loss"]) for row in rows if row["ply_loss"]]
    cells.append(spread(losses, 2) if losses else "0")
    cells.append(", ".join(sorted({row["code"] for row in rows})))
    return "| " + " | ".join(cells) + " |"


def section(scene: str, rows: Sequence[Row]) -> list[str]:
    """The table of one scene."""
    regimes = sorted(json.loads(rows[0]["regimes"]))
    heads = ["backbone, sampler", "seeds", "PSNR", *(f"PSNR {name}" for name in regimes)]
    heads += ["SSIM", "seconds", "steps", "views", "primitives", "PLY loss, dB", "code"]
    lines = [f"## {scene}", "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for backbone, sampler in sorted({(row["backbone"], row["sampler"]) for row in rows}):
        same = [row for row in rows if (row["backbone"], row["sampler"]) == (backbone, sampler)]
        lines.append(line(f"{backbone}, {sampler}", same, regimes))
    return [*lines, ""]


def on_the_way(rows: Sequence[Row]) -> list[str]:
    """PSNR of one scene at equal steps and at equal seconds before the end."""
    seconds = [round(share * float(rows[0]["budget"])) for share in SHARES]
    heads = ["backbone, sampler", *(f"{n:,} steps" for n in STEPS), *(f"{s} s" for s in seconds)]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for backbone, sampler in sorted({(row["backbone"], row["sampler"]) for row in rows}):
        same = [row for row in rows if (row["backbone"], row["sampler"]) == (backbone, sampler)]
        curves = [json.loads(row["curve"]) for row in same]
        cells = [read_off(curves, 0, steps) for steps in STEPS]
        cells += [read_off(curves, 1, passed) for passed in seconds]
        lines.append("| " + " | ".join([f"{backbone}, {sampler}", *cells]) + " |")
    return [*lines, ""]


def read_off(curves: Sequence[Sequence[Sequence[float]]], axis: int, place: float) -> str:
    """Mean PSNR there, straight between evaluations; `-` where some run was over by then."""
    if any(curve[-1][axis] < place for curve in curves):
        return "-"
    found = [np.interp(place, [p[axis] for p in curve], [p[2] for p in curve]) for curve in curves]
    return f"{mean(map(float, found)):.2f}"


def mixture(rows: Iterable[Row]) -> list[str]:
    """A warning where the rows are of several versions of the code."""
    codes = sorted({row["code"] for row in rows})
    if len(codes) < 2:
        return []
    return [
        f"**The rows are of {len(codes)} versions of the code ({', '.join(codes)}): compare rows",
        "of the same version only.** The last column has the commit.",
        "",
    ]


def page(rows: Sequence[Row], command: str) -> str:
    """The whole page."""
    machines = sorted({row["cpu"] for row in rows})
    dates = sorted(row["date"][:10] for row in rows)
    lines = ["# Backbones at equal training time", ""]
    lines += [
        f"Made by `{command}` on {', '.join(machines)},",
        f"{dates[0]} to {dates[-1]}: one core per run, {rows[0]['budget']} training seconds each.",
        "`epoch` draws one view per step, `random` two.",
        "Mean and standard deviation over seeds; PLY loss: what baking to `point_cloud.ply` costs.",
        "Second table of each scene: PSNR on the way, mean over seeds.",
        "",
        *mixture(rows),
    ]
    for scene in sorted({row["scene"] for row in rows}):
        lines += section(scene, [row for row in rows if row["scene"] == scene])
        lines += on_the_way([row for row in rows if row["scene"] == scene])
    return "\n".join(lines)


def main() -> None:
    """Runs what is missing, then writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--backbones", nargs="+", default=list(BACKBONES))
    parser.add_argument("--samplers", nargs="+", default=["epoch", "random"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=140.0)
    parser.add_argument("--max-size", type=int, default=400)
    parser.add_argument("--jobs", type=int, default=2, help="runs at the same time")
    parser.add_argument("--out", type=Path, default=Path("runs/backbones"))
    parser.add_argument("--rows", type=Path, default=RESULTS / "backbones.csv")
    parser.add_argument("--table", type=Path, default=RESULTS / "backbones.md")
    arguments = parser.parse_args()
    # Seeds vary slowest: an interrupted table has every method, with fewer seeds.
    order = product(arguments.seeds, arguments.scenes, arguments.backbones, arguments.samplers)
    jobs = [Job(scene, backbone, sampler, seed) for seed, scene, backbone, sampler in order]
    names = ("scene", "backbone", "sampler", "seed")
    done = {tuple(row[name] for name in names) for row in stored(arguments.rows)}
    lock = Lock()

    def one(job: Job) -> None:
        row = run(job, arguments)
        with lock:
            append(arguments.rows, row)
            print(*job.key, row["psnr"], row["seconds"], flush=True)

    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(one, [job for job in jobs if job.key not in done]))
    command = f"python benchmarks/backbones.py SCENES --seconds {arguments.seconds:g}"
    arguments.table.write_text(page(stored(arguments.rows), command), encoding="utf-8")


if __name__ == "__main__":
    main()
