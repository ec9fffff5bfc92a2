"""Runs with planted figures, for the page of benchmarks/paper.py."""

import csv
import json

from support.run_folders import DEFINITIONS, RunFolder

SCENES = ("city", "town", "field", "wood")
SEEDS = (1, 2, 3)


def write_run(folder, scene, seed, psnr, **more):
    """A finished run that ended with a PSNR, plain and after colour correction."""
    RunFolder(
        scene=scene, seed=seed, final=psnr, evaluations=2,
        definitions={"psnr_cc": DEFINITIONS["psnr"]}, **more,
    ).write(folder)  # fmt: skip
    path = folder / "summary.json"
    summary = json.loads(path.read_text())
    for figures in (summary["overall"], *summary["regimes"].values()):
        figures["psnr_cc"] = figures["psnr"]
    path.write_text(json.dumps(summary))


def write_probes(sweep, figures):
    """Gives every run a table of probes, two with each block's figures."""
    columns = sorted({column for each in figures.values() for column in each})
    for run in (sweep / "runs").iterdir():
        with (run / "diagnostics.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["step", "metric", "block", *columns])
            for step in (10, 20):
                for (metric, block), own in figures.items():
                    writer.writerow([step, metric, block, *(own.get(c, "") for c in columns)])
