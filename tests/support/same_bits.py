"""Comparison of two runs that must be the same bit for bit."""

import csv
import json
from collections.abc import Collection
from pathlib import Path

CLOCKS = {"train_seconds", "cpu_seconds", "peak_memory_mib"}


def bits(folder: Path, steps: Collection[str] | None = None) -> dict[str, object]:
    """Everything of a run's folder that does not depend on clocks.

    Args:
        folder: The run's folder.
        steps: The rows of metrics.csv that count; a run that was stopped has one more.
    """
    checkpoint = max((folder / "checkpoints").glob("step-*"))
    state = json.loads((checkpoint / "state.json").read_text())
    with (folder / "metrics.csv").open() as file:
        rows = [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(file)]
    return {
        "tensors": (checkpoint / "tensors.safetensors").read_bytes(),
        "state": {key: state[key] for key in ("step", "plugins", "generators")},
        "ply": (folder / "point_cloud.ply").read_bytes(),
        "metrics": [row for row in rows if steps is None or row["step"] in steps],
    }
