"""Short trainings and renders whose bits are known, by the processor and versions that made them.

    python -m support.known_bits        # in tests/; a change of bits is a decision

writes what this machine makes of them into integration/data/bits.json, beside what others made.
"""

import hashlib
import json
import platform
import tempfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import torch
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.run.bundled import bundled_scene
from crossgrad_core.run.checkpoint.checkpoint import latest, load

PATH = Path(__file__).parents[1] / "integration" / "data" / "bits.json"
#: Versions that decide about the order of sums, about instructions, or about decoded photos.
PACKAGES = ("llvmlite", "numba", "numpy", "pillow", "torch")
#: Four edits in fifty steps.
USUAL: Mapping[str, Any] = {
    "steps": 50,
    "threads": 1,
    "seed": 3,
    "events": "steps",
    "densify_from": 10,
    "densify_every": 10,
    "densify_until": 45,
    "eval_every": 50,
    "start": "sfm",
}
BACKBONES = ("analytic", "distance", "mip", "octree", "pixel", "scaffold", "vanilla")
#: Name -> the settings of a run; what begins with `bundled` has the bundled scene.
CASES: Mapping[str, Mapping[str, Any]] = {
    "bundled": {"max_size": 80, "reset_every": 30, "growth": "curve", "max_gaussians": 24_000},
    "bundled filled": {"max_size": 80, "start": "filled"},
    **{each: {"backbone": each, "operator": "symmetric"} for each in BACKBONES},
    "exposure": {"exposure": "affine", "views": 3},
    "mcmc": {"densifier": "mcmc", "resolution": "octaves", "views": 1},
}
#: Cells of a side of the figures of a render.
CELLS = 4


def key() -> str:
    """The processor and the versions that a result belongs to."""
    processor = f"{platform.machine()} {llvm.get_host_cpu_name()}"
    made_for = torch.backends.cpu.get_cpu_capability()
    versions = " ".join(f"{name} {version(name)}" for name in PACKAGES)
    return f"{platform.system()} {processor} {made_for}; {versions}"


def made(name: str, folder: Path) -> dict[str, Any]:
    """What this machine makes of a case.

    Args:
        name: Which.
        folder: An empty folder for the scene and the run.

    Returns:
        `training` and `render`, the hashes of the parameters and of the first held-out view;
        `figures`, name -> means and root mean squares of tensors, means of parts of the render.
    """
    bundled = name.startswith("bundled")
    views = {"views": 6, "folders": ("near", "far")}
    scene = bundled_scene() if bundled else write_tiny_scene(folder / "scene", **views)
    run = cg.run(scene, out=folder / "run", **{**USUAL, **CASES[name]})
    parameters = dict(sorted(load(latest(run.folder)).parameters.items()))
    image = run.render(run.scene.test_views[0].name)
    tensors = {name: tensor.detach().numpy() for name, tensor in parameters.items()}
    return {
        "training": _hash(*tensors.values()),
        "render": _hash(image),
        "figures": {
            "render": [_mean(part) for row in _parts(image, 0) for part in _parts(row, 1)],
            **{name: [_mean(t), _mean(t.astype(float) ** 2) ** 0.5] for name, t in tensors.items()},
        },
    }


def _hash(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(str((array.dtype, array.shape)).encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def _parts(image: np.ndarray, axis: int) -> list[np.ndarray]:
    return np.array_split(image, CELLS, axis=axis)


def _mean(array: np.ndarray) -> float:
    return float(f"{array.mean(dtype=np.float64) if array.size else 0.0:.7g}")


def known() -> dict[str, dict[str, Any]]:
    """Key -> case -> what was made of it."""
    found: dict[str, dict[str, Any]] = json.loads(PATH.read_text(encoding="utf-8"))
    return found


def main() -> None:
    """Writes what this machine makes of all cases."""
    with tempfile.TemporaryDirectory() as folder:
        ours = {name: made(name, Path(folder) / name) for name in CASES}
    found = known() if PATH.is_file() else {}
    PATH.write_text(json.dumps({**found, key(): ours}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
