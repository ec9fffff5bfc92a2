"""Quality at equal steps over seeds: trains a scene once per method and seed, prints a table.

    python benchmarks/quality.py SCENE --max-size 400 --steps 2000 --seeds 0 1 2 \
        --methods epoch random [--threads 1] [--out DIR]

A method is a sampler, or `sampler/operator`, or `sampler/operator/K`. Every run goes through the
command line's own code. Runs that are already in --out are not repeated.
"""

import argparse
import json
from pathlib import Path
from statistics import mean, stdev

from _machine import facts

from crossgrad_core.run import app
from crossgrad_core.run.results.summary import read_summary


def settings(arguments: argparse.Namespace, method: str, seed: int, out: Path) -> dict[str, object]:
    """The settings of one run."""
    sampler, operator, views = [*method.split("/"), None, None][:3]
    given: dict[str, object] = {
        "scene": str(arguments.scene),
        "out": str(out),
        "steps": arguments.steps,
        "seconds": arguments.seconds,
        "seed": seed,
        "threads": arguments.threads,
        "sampler": {"name": sampler},
        "operator": {"name": operator or "sum"},
        "reading": {"max_size": arguments.max_size},
    }
    if views is not None:
        given["views"] = int(views)
    return {name: value for name, value in given.items() if value is not None}


def one_run(arguments: argparse.Namespace, method: str, seed: int) -> dict[str, float]:
    """The final figures of one run; trained only where it is not in --out yet."""
    out = arguments.out / f"{method.replace('/', '-')}-seed{seed}"
    if not (out / "summary.json").is_file():
        app.run(settings(arguments, method, seed, out), verbosity=-1)
    summary = read_summary(out)
    if summary["status"] == "stopped":
        app.run({}, resume=out, verbosity=-1)
        summary = read_summary(out)
    figures = {
        "psnr": summary["overall"]["psnr"],
        "ssim": summary["overall"]["ssim"],
        "seconds": summary["train_seconds"],
        "steps": summary["step"],
        "views": summary["views"],
        "primitives": summary["primitives"],
    }
    regimes = {f"psnr {name}": each["psnr"] for name, each in summary["regimes"].items()}
    return {**figures, **regimes}


def row(method: str, runs: list[dict[str, float]]) -> str:
    """One line of the table: mean and, over seeds, standard deviation."""
    cells = [method]
    for name in runs[0]:
        values = [run[name] for run in runs]
        digits = 4 if name == "ssim" else 2 if "psnr" in name else 1 if name == "seconds" else 0
        spread = f" ± {stdev(values):.{digits}f}" if len(values) > 1 else ""
        cells.append(f"{mean(values):.{digits}f}{spread}")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Runs the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--methods", nargs="+", default=["epoch", "random"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=None)
    parser.add_argument("--seconds", type=float, default=None)
    parser.add_argument("--max-size", type=int, default=None)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/quality"))
    arguments = parser.parse_args()
    runs = {
        method: [one_run(arguments, method, seed) for seed in arguments.seeds]
        for method in arguments.methods
    }
    columns = ["method", *next(iter(runs.values()))[0]]
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for method, each in runs.items():
        print(row(method, each))
    print(f"\n{arguments.scene.name}, seeds {arguments.seeds}, {json.dumps(facts())}")


if __name__ == "__main__":
    main()
