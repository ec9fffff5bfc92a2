"""Compare frame and PSNR of a COLMAP scene before and after a move to map coordinates.

    python benchmarks/moved_scene.py SCENE --steps 600 --max-size 100

The scene is trained at its position and at a distant position. For comparison, it is also trained
at its position with initial positions that are changed at random by one unit in the last place of
float32. The PSNR of the moved scene should be within the range of the PSNR of these runs.
"""

import argparse
import json
import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from _machine import code, facts

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.scene import Scene, centers_of
from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.run.assemble import assemble, read_scene
from crossgrad_core.run.export import renderer
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state


def moved(scene: Path, offset: tuple[float, ...], to: Path) -> Path:
    """Write the scene with `offset` added to every position, and link its photos."""
    guard_pycolmap()
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(offset)))
    (to / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(to / "sparse" / "0"))
    os.symlink((scene / "images").resolve(), to / "images")
    return to


def psnr(config: RunConfig, scene: Scene, seed: int | None = None) -> float:
    """Return the held-out PSNR after a run.

    If a seed is given, initial positions are changed at random.
    """
    setup = assemble(config, scene, "colmap")
    state = first_state(setup)
    if seed is not None:
        means = state.parameters["means"].detach()
        signs = np.random.default_rng(seed).choice([-np.inf, np.inf], means.shape)
        aside = torch.nextafter(means, torch.from_numpy(signs).to(means))
        state.parameters["means"] = aside.requires_grad_()
    for _ in range(setup.schedule.total):
        timed_step(setup, state)
    found = evaluate(scene.test_views, renderer(setup, state), setup.metrics).overall["psnr"]
    assert found is not None
    return found


def main() -> None:
    """Print one JSON line for each run, and one summary line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--max-size", type=int, default=100)
    parser.add_argument("--offset", type=float, nargs=3, default=(5e5, 5e6, 100.0))
    parser.add_argument(
        "--runs", type=int, default=10, help="number of runs from perturbed positions"
    )
    given = parser.parse_args()
    configure_threads(1)
    reading = {"max_size": given.max_size}
    settings = {"steps": given.steps, "threads": 1, "data": reading}
    with tempfile.TemporaryDirectory() as folder:
        scenes = {}
        # Write both scenes with the same code, because writing may change the order of the points.
        for name, offset in (("in place", (0.0, 0.0, 0.0)), ("moved", given.offset)):
            path = moved(given.scene, offset, Path(folder) / name)
            scenes[name] = read_scene(RunConfig(scene=path, **settings), path)[0]
        config = RunConfig.model_validate(settings)
        runs = {name: psnr(config, scene) for name, scene in scenes.items()}
        print(json.dumps(runs), flush=True)
        for seed in range(given.runs):
            runs[f"aside {seed}"] = psnr(config, scenes["in place"], seed)
            print(json.dumps({f"aside {seed}": runs[f"aside {seed}"]}), flush=True)
        here, away = scenes.values()
    others = [value for name, value in runs.items() if name != "moved"]
    views = centers_of(here.views) - centers_of(away.views)
    summary = {
        "scene": given.scene.name,
        "offset": list(given.offset),
        "steps": given.steps,
        "max_size": given.max_size,
        "cameras apart": float(np.abs(views).max()),
        "points apart": float(np.abs(here.points - away.points).max()),
        "psnr in place": runs["in place"],
        "psnr moved": runs["moved"],
        "psnr of the others": [min(others), max(others)],
        "code": code(),
        **facts(),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
