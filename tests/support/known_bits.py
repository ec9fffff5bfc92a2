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
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.run.checkpoint import latest, load

PATH = Path(__file__).parents[1] / "integration" / "data" / "bits.json"
#: Versions that decide about the order of sums, about instructions, or about decoded photos.
PACKAGES = ("llvmlite", "numba", "numpy", "pillow", "torch")
#: Four edits in fifty steps.
USUAL: Mapping[str, Any] = {
    "steps": 50,
    "threads": 1,
    "seed": 3,
    "schedule_unit": "steps",
    "densify_from": 10,
    "densify_every": 10,
    "densify_until": 45,
    "eval_every": 50,
    "initializer": "points",
    "exposure": "none",
    "sampler": "random",
    "views": 2,
    "beta1": 0.9,
    "beta2": 0.999,
    "rules": {"floaters": False, "scale-clamp": False},
    "position_lr": "extent",
}
BACKBONES = ("analytic", "distance", "mip", "octree", "pixel", "scaffold", "vanilla")
#: Name -> the settings of a run; what begins with `bundled` has the bundled scene.
CASES: Mapping[str, Mapping[str, Any]] = {
    "bundled": {
        "max_size": 80,
        "reset_every": 30,
        "growth": "budget",
        "max_gaussians": 24_000,
        "densifier": {"name": "adc", "division": "drawn"},
    },
    "bundled filled": {"max_size": 80, "initializer": "fill-gaps"},
    **{each: {"backbone": each, "operator": "symmetric"} for each in BACKBONES},
    "exposure": {"exposure": "affine", "views": 3},
    "few passes": {"beta2": None, "backbone": {"name": "vanilla", "lr_scales": 0.0025}},
    "mcmc": {"densifier": "mcmc", "resolution": "octaves", "views": 1},
}


def key() -> str:
    """The processor and the versions that a result belongs to."""
    processor = f"{platform.machine()} {llvm.get_host_cpu_name()}"
    made_for = torch.backends.cpu.get_cpu_capability()
    versions = " ".join(f"{name} {version(name)}" for name in PACKAGES)
    return f"{platform.system()} {processor} {made_for}; {versions}"


def made(name: str, folder: Path) -> dict[str, str]:
    """What this machine makes of a case.

    Args:
        name: Which.
        folder: An empty folder for the scene and the run.

    Returns:
        `training` and `render`, the hashes of the parameters and of the first held-out view.
    """
    bundled = name.startswith("bundled")
    views = {"views": 6, "folders": ("near", "far")}
    scene = bundled_scene() if bundled else write_tiny_scene(folder / "scene", **views)
    run = cg.run(scene, out=folder / "run", **{**USUAL, **CASES[name]})
    parameters = dict(sorted(load(latest(run.folder)).parameters.items()))
    return {
        "training": _hash(*(tensor.detach().numpy() for tensor in parameters.values())),
        "render": _hash(run.render(run.scene.test_views[0].name)),
    }


def _hash(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(str((array.dtype, array.shape)).encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def known() -> dict[str, dict[str, dict[str, str]]]:
    """Key -> case -> what was made of it."""
    found: dict[str, dict[str, dict[str, str]]] = json.loads(PATH.read_text(encoding="utf-8"))
    return found


def main() -> None:
    """Writes what this machine makes of all cases."""
    with tempfile.TemporaryDirectory() as folder:
        ours = {name: made(name, Path(folder) / name) for name in CASES}
    found = known() if PATH.is_file() else {}
    PATH.write_text(json.dumps({**found, key(): ours}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
