"""The modules of benchmarks/paper.py, and runs with planted differences."""

import csv
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.paper_runs import SCENES, SEEDS, write_run

from crossgrad_plugins.sweep.grid import Grid

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
MODULES = ("_paper_data", "_paper_runs", "_paper_verdicts", "_paper_page", "paper")


@pytest.fixture(scope="session")
def modules():
    """The modules by their names without `_paper_`; `paper` is the script."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        found = {name.removeprefix("_paper_"): import_module(name) for name in MODULES}
    finally:
        sys.path.remove(str(BENCHMARKS))
    return SimpleNamespace(**found)


@pytest.fixture(scope="session")
def planted(tmp_path_factory):
    """Writes a sweep whose arms differ by what is planted, with noise that pairs do not share."""

    def write(name, arms, scenes=SCENES, noise=0.02, settings=(), **more):
        root = tmp_path_factory.mktemp("sweeps")
        rng = np.random.default_rng(0)
        lines = []
        for arm, level in arms.items():
            for scene in scenes:
                for seed in SEEDS:
                    run = f"r{len(lines)}"
                    psnr = 20.0 + SCENES.index(scene) + 0.3 * seed + level
                    folder = root / name / "runs" / run
                    psnr += noise * rng.normal()
                    own = dict(settings).get(arm, {})
                    write_run(folder, scene, seed, psnr, settings=own, **more)
                    lines.append((run, arm))
        with (root / name / "runs.csv").open("w", newline="") as file:
            csv.writer(file).writerows([("run", "configuration"), *lines])
        return root / name

    return write


@pytest.fixture(scope="session")
def grid_of():
    """A grid of arms on the scenes of planted sweeps."""

    def make(arms, scenes=SCENES):
        return Grid.model_validate(
            {
                "scenes": [f"/scenes/{name}" for name in scenes],
                "seeds": list(SEEDS),
                "arms": [{"name": name} for name in arms],
            }
        )

    return make
