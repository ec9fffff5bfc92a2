"""Conditions that the folder of a run must fulfil after any fault."""

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from crossgrad_plugins.exporters.ply_file import read_ply

#: Columns of metrics.csv that no two runs share.
CLOCKS = frozenset({"train_seconds", "cpu_seconds", "peak_memory_mib"})
CHECKPOINT_FILES = ("state.json", "tensors.safetensors")


def parses(folder: Path) -> None:
    """Every file that has its final name is whole."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not is_scratch(path.relative_to(folder)):
            try:
                READERS.get(path.suffix, Path.read_bytes)(path)
            except Exception as error:
                error.add_note(f"{path}, {path.stat().st_size} bytes")
                raise


def is_scratch(path: Path) -> bool:
    """Whether a name says that its file or folder is not finished; it counts as no result."""
    return any(part.startswith((".", "scratch")) for part in path.parts)


def _csv(path: Path) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows, f"{path} is empty"
    assert len({len(row) for row in rows}) == 1, f"{path} has a row of another length"
    if path.name == "metrics.csv":
        steps = [int(row[0]) for row in rows[1:]]
        assert steps == sorted(set(steps)), f"{path}: steps {steps}"


def _json(path: Path) -> None:
    assert isinstance(json.loads(path.read_text(encoding="utf-8")), dict), path


def _yaml(path: Path) -> None:
    assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict), path


def _tensors(path: Path) -> None:
    from safetensors.numpy import load_file

    assert load_file(path), path


def _image(path: Path) -> None:
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        image.load()


def _ply(path: Path) -> None:
    assert len(read_ply(path)) > 0


READERS: Mapping[str, Any] = {
    ".csv": _csv,
    ".json": _json,
    ".yaml": _yaml,
    ".safetensors": _tensors,
    ".png": _image,
    ".ply": _ply,
    ".txt": lambda path: path.read_text(encoding="utf-8"),
}


def same_bits(one: Path, other: Path) -> None:
    """A finished run has the last checkpoint, the PLY and the figures of the undisturbed one.

    Args:
        one: The undisturbed run.
        other: The run after a fault; where it was asked to stop, it has a further evaluation.
    """
    first, second = (newest(folder) for folder in (one, other))
    assert first.name == second.name
    tensors = [(each / "tensors.safetensors").read_bytes() for each in (first, second)]
    assert tensors[0] == tensors[1], "tensors differ"
    states = [json.loads((each / "state.json").read_text()) for each in (first, second)]
    for key in ("step", "plugins", "generators", "adam_steps"):
        assert states[0][key] == states[1][key], f"state.json: {key} differs"
    clouds = [(each / "point_cloud.ply").read_bytes() for each in (one, other)]
    assert clouds[0] == clouds[1], "point_cloud.ply differs"
    missing = [row for row in figures(one) if row not in figures(other)]
    assert not missing, missing


def newest(folder: Path) -> Path:
    """The last checkpoint."""
    return max((folder / "checkpoints").glob("step-*"))


def figures(folder: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv without what no two runs share."""
    with (folder / "metrics.csv").open(newline="", encoding="utf-8") as file:
        return [
            {name: text for name, text in row.items() if name not in CLOCKS}
            for row in csv.DictReader(file)
        ]
