r"""Compare the final quality of runs with a time limit between several commits.

    python benchmarks/time_to_quality.py run OUT --scene SCENE [--scene SCENE ...] --core 0 \
        --code old=VENV_OLD/bin/crossgrad --code "new=VENV/bin/crossgrad --split every" \
        --seconds 5 10 20 30:10 70:23.3 140:46.7 --seeds 1 2 3 4 5 6
    python benchmarks/time_to_quality.py table OUT

The text `30:10` gives the first code 30 seconds and the second code 10 seconds. On a machine with
other users, use `--steps` instead of `--seconds` to end runs after a number of steps. The PLY files
of both codes are drawn on the held-out views of the last code. The first code must hold out these
views, too. Photos have a longer side of 400 px, or of `--max-size` (0: the default size). A run
uses one thread for each named core (Linux). The two runs of a pair follow each other on these
cores. Finished runs are not repeated. PSNR is measured on the exported PLY on black, drawn by
`crossgrad eval --file` and, if `--max-size` is not 0, also by `viewer.py`.
`table OUT --figure NAME`
compares another metric of the held-out views in summary.json, such as `ssim`.

    python benchmarks/time_to_quality.py run OUT --scene SCENE [--scene SCENE ...] --core 0 1 \
        --code long=VENV/bin/crossgrad --code new=VENV/bin/crossgrad --max-size 0 --seconds 600:60
    python benchmarks/time_to_quality.py share OUT

compares short runs with long runs of one code. The share is the gain of the short run divided by
the gain of the long run. A gain is the PSNR minus the PSNR of an image in the training photos' mean
colour.
"""

import argparse
import csv
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import torch
import viewer

import crossgrad_core as cg
from crossgrad_core.contract.scene import Scene
from crossgrad_plugins.compare.statistics import Estimate, estimate, verdicts

Row = dict[str, Any]


@dataclass(frozen=True)
class Code:
    """A commit with its name, its `crossgrad` program, and options of `crossgrad run`."""

    name: str
    program: str
    options: tuple[str, ...]

    @classmethod
    def of(cls, text: str) -> "Code":
        """Parse a text `NAME=CROSSGRAD [OPTIONS]`."""
        name, _, words = text.partition("=")
        program, *options = shlex.split(words)
        return cls(name, program, tuple(options))

    def train(self, scene: Path, folder: Path, threads: int, size: int, *length: str) -> None:
        """Train into a folder, which must not exist before."""
        command = [self.program, "run", str(scene), "--out", str(folder)]
        command += ["--threads", str(threads), *(["--max-size", str(size)] if size else [])]
        command += [*length, *self.options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def run(given: argparse.Namespace) -> None:
    """Start the runs of missing cases."""
    os.sched_setaffinity(0, given.core)
    kind = len(given.core), given.max_size
    codes = [Code.of(text) for text in given.code]
    for code in codes:
        # Compile all kernels that a run needs before the first timed run.
        warm = given.out / f"warm-up-{code.name}-{given.core[0]}"
        if not warm.exists():
            # Without a time limit, crossgrad refuses the option --clock.
            timed = any(option.partition("=")[0] == "--clock" for option in code.options)
            length = ("--seconds", "60") if timed else ("--steps", "700")
            code.train(given.scene[0], warm, *kind, *length)
    for seed, scene, lengths in _cases(given):
        folders = {
            code: given.out / f"{scene.name}-{re.sub('[: ]', '_', lengths)}-{code.name}-{seed}"
            for code in codes
        }
        if all((folder / "row.json").exists() for folder in folders.values()):
            continue
        numbers, _, unit = lengths.partition(" ")
        each, option = numbers.split(":"), f"--{unit or 'seconds'}"
        pairs = [(code, each[n % len(each)]) for n, code in enumerate(codes)]
        for code, length in pairs if seed % 2 else reversed(pairs):
            if not _finished(folders[code]):
                shutil.rmtree(folders[code], ignore_errors=True)
                code.train(scene, folders[code], *kind, option, length, "--seed", str(seed))
        for code, folder in folders.items():
            row = {"code": code.name, "scene": scene.name, "lengths": lengths, "seed": seed}
            # Use the independent renderer only for small photos, because it is slow.
            row |= _figures(folder, folders[codes[-1]], independent=given.max_size > 0)
            (folder / "row.json").write_text(json.dumps(row))


def _finished(folder: Path) -> bool:
    """Return True if a run has finished."""
    path = folder / "summary.json"
    return path.exists() and json.loads(path.read_text())["status"] == "finished"


def _held_out(folder: Path) -> set[str]:
    """Return the names of the views on which a run was evaluated."""
    with (folder / "per_view.csv").open(newline="") as file:
        return {row["name"] for row in csv.DictReader(file)}


def _cases(given: argparse.Namespace) -> Iterator[tuple[int, Path, str]]:
    for seed in given.seeds:
        for scene in given.scene:
            for lengths in (*given.seconds, *(f"{each} steps" for each in given.steps)):
                yield seed, scene, lengths


def _figures(folder: Path, judge: Path, *, independent: bool) -> Row:
    """Return the metrics of a run's PLY, drawn on the held-out views of another run."""
    if _held_out(folder) != _held_out(judge):
        raise SystemExit(
            f"{folder} and {judge} do not hold out the same views: give both a --split"
        )
    summary = json.loads((folder / "summary.json").read_text())
    ply = folder / "point_cloud.ply"
    command = [sys.executable, "-m", "crossgrad_core", "eval", str(judge), "--file", str(ply)]
    shown = subprocess.run([*command, "--threads", "1"], check=True, capture_output=True, text=True)
    (drawn,) = (line.split()[2] for line in shown.stdout.splitlines() if line.startswith("overall"))
    run = cg.open(judge)
    return {
        "psnr": summary["overall"]["psnr"],
        "mean_colour": _mean_colour(run.scene),
        "ply": float(drawn),
        **({"viewer": viewer.psnr(run, ply)} if independent else {}),
        "steps": summary["step"],
        "primitives": summary["primitives"],
        "seconds": summary["train_seconds"],
        "commit": (summary.get("environment") or {}).get("commit") or "not recorded",
    }


def _mean_colour(scene: Scene) -> float:
    """Return the mean PSNR of the training photos' mean colour on the held-out views."""
    photos = [view.photo.image().double() / 255 for view in scene.train_views]
    mean = torch.stack([photo.mean((0, 1)) for photo in photos]).mean(0)
    errors = [
        (view.photo.image().double() / 255 - mean).square().mean() for view in scene.test_views
    ]
    return fmean(-10.0 * math.log10(error) for error in errors)


def table(given: argparse.Namespace) -> None:
    """Print means and standard deviations, and the gain of each code over `old`."""
    by_case: dict[tuple[str, str], dict[str, dict[int, Row]]] = defaultdict(dict)
    for path in sorted(given.out.glob("*/row.json")):
        row = json.loads(path.read_text())
        row["compared"] = row["ply"] if given.figure is None else _told(path.parent, given.figure)
        by_case[row["scene"], row["lengths"]].setdefault(row["code"], {})[row["seed"]] = row
    cases = sorted(by_case.items(), key=lambda case: (case[0][0], _first(case[0][1])))
    titles = "scene | code | commit | training s | seeds | PLY, dB | viewer.py, dB | steps"
    print(f"| {titles} | Gaussians |\n{'|---' * 9}|")
    for (scene, _), codes in cases:
        for code, own in sorted(codes.items(), reverse=True):
            print(f"| {scene} | {code} | {' | '.join(_cells(list(own.values())))} |")
    old: dict[tuple[str, str], dict[int, Row]] = {}
    for (scene, lengths), codes in cases:
        if "old" in codes:
            # If a case was not run with the code `old`, compare it with the first case of equal
            # length that was.
            old[scene, lengths] = codes["old"]
            first, _, unit = lengths.partition(" ")
            alone = " ".join([first.split(":")[0], *([unit] if unit else [])])
            old.setdefault((scene, alone), codes["old"])
    for code in sorted({code for _, codes in cases for code in codes} - {"old"}):
        _print_gains(code, cases, old, given.figure)


def _told(folder: Path, figure: str) -> float:
    """Return a metric of a run over all held-out views."""
    return float(json.loads((folder / "summary.json").read_text())["overall"][figure])


def _print_gains(
    code: str,
    cases: Sequence[tuple[tuple[str, str], dict[str, dict[int, Row]]]],
    old: Mapping[tuple[str, str], dict[int, Row]],
    figure: str | None,
) -> None:
    """Print the gains of a code over `old`, by scene and pooled.

    Scenes whose runs have equal lengths are pooled.
    """
    gains: dict[str, dict[str, list[float]]] = defaultdict(dict)
    margin, digits = (0.005, 4) if figure == "ssim" else (0.1, 2)
    for (scene, lengths), codes in cases:
        before, now = old.get((scene, lengths), {}), codes.get(code, {})
        if seeds := sorted(before.keys() & now.keys()):
            gains[lengths][scene] = [
                now[seed]["compared"] - before[seed]["compared"] for seed in seeds
            ]
    found = [
        (scene, lengths, estimate(own, [scene] * len(own), margin))
        for lengths, by_scene in gains.items()
        for scene, own in by_scene.items()
    ]
    shown = figure or "dB"
    titles = f"scene | length | {code} - old, {shown} | 95 % | 90 % | pairs | verdict"
    print(f"\n| {titles} |\n{'|---' * 7}|")
    for (*what, each), verdict in zip(found, verdicts([e for *_, e in found]), strict=True):
        print(f"| {' | '.join([*what, *_gain(each, digits), verdict.value])} |")
    for lengths, by_scene in gains.items():
        if len(by_scene) > 1:
            own = [gain for each in by_scene.values() for gain in each]
            scenes = [scene for scene, each in by_scene.items() for _ in each]
            (verdict,) = verdicts([whole := estimate(own, scenes, margin)])
            print(f"| all | {lengths} | {' | '.join(_gain(whole, digits))} | {verdict.value} |")


def _gain(each: Estimate, digits: int) -> Iterator[str]:
    yield f"{each.center:+.{digits}f}"
    yield from (
        f"[{low:+.{digits}f}, {high:+.{digits}f}]" for low, high in (each.wide, each.narrow)
    )
    yield str(each.pairs)


def share(given: argparse.Namespace) -> None:
    """Print the share of the gain of `long` over the mean colour that `new` reaches."""
    by_case: dict[tuple[str, str, int], dict[str, Row]] = defaultdict(dict)
    for path in sorted(given.out.glob("*/row.json")):
        row = json.loads(path.read_text())
        by_case[row["scene"], row["lengths"], row["seed"]][row["code"]] = row
    titles = "scene | seed | commit | mean colour, dB | training s | PLY, dB | share | Gaussians"
    print(f"| {titles} |\n{'|---' * 8}|")
    for (scene, _, seed), codes in sorted(by_case.items()):
        if not codes.keys() >= {"long", "new"}:
            continue
        short, long = codes["new"], codes["long"]
        base = short["mean_colour"]
        share = (short["ply"] - base) / (long["ply"] - base)
        cells = [scene, str(seed), ", ".join(sorted({short["commit"], long["commit"]}))]
        cells += [f"{base:.2f}", f"{short['seconds']:.1f}, {long['seconds']:.1f}"]
        cells += [f"{short['ply']:.2f}, {long['ply']:.2f}", f"{share:.1%}"]
        cells += [f"{short['primitives']:,}, {long['primitives']:,}"]
        print(f"| {' | '.join(cells)} |")


def _first(lengths: str) -> float:
    """Return the length of the runs of the first code."""
    return float(lengths.partition(" ")[0].split(":")[0])


def _cells(own: list[Row]) -> Iterator[str]:
    yield ", ".join(sorted({row["commit"] for row in own}))
    yield f"{fmean(row['seconds'] for row in own):.1f}"
    yield str(len(own))
    for name in ("ply", "viewer"):
        values = [row[name] for row in own if name in row]
        spread = f" ± {stdev(values):.2f}" if len(values) > 1 else ""
        yield f"{fmean(values):.2f}{spread}" if values else "-"
    for name in ("steps", "primitives"):
        yield f"{fmean(row[name] for row in own):,.0f}"


def main() -> None:
    """Start missing runs, or print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    runs = commands.add_parser("run", help="run missing cases")
    runs.set_defaults(do=run)
    runs.add_argument("out", type=Path)
    runs.add_argument("--code", action="append", required=True, metavar="NAME=CROSSGRAD [OPTIONS]")
    runs.add_argument("--scene", action="append", type=Path, required=True)
    runs.add_argument("--seconds", nargs="+", default=[], metavar="S[:S]")
    runs.add_argument("--steps", nargs="+", default=[], metavar="N[:N]")
    runs.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5, 6])
    runs.add_argument("--core", nargs="+", type=int, default=[0])
    runs.add_argument("--max-size", type=int, default=400, metavar="PIXELS")
    tables = commands.add_parser("table", help="print a table of the finished runs")
    tables.set_defaults(do=table)
    tables.add_argument("out", type=Path)
    tables.add_argument("--figure", metavar="NAME")
    shares = commands.add_parser(
        "share", help="print the share of the long runs' gain that short runs reach"
    )
    shares.set_defaults(do=share)
    shares.add_argument("out", type=Path)
    given = parser.parse_args()
    if given.do is run and not (given.seconds or given.steps):
        runs.error("the length of the runs is missing: give --seconds or --steps")
    given.do(given)


if __name__ == "__main__":
    main()
