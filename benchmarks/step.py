"""Median seconds of one whole training step on a fixed case, as one JSON line.

A step is: decode with SH degree 3, render, loss against a random photo, backward pass, one Adam
pass over all parameters.

    python benchmarks/step.py CASE.npz [--reps N] [--threads N] [--max-alpha A]
"""

import argparse
import json
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.numerics.spherical import SH_C0
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_plugins.losses.photometric.loss import photometric_loss
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer

#: Late enough for SH degree 3 in the published schedule.
STEP = 5000


def parameters_of(case: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """The case as vanilla parameters; higher bands small and random."""
    count = case["means"].shape[0]
    opacities = torch.from_numpy(case["opacities"]).clamp(1e-4, 1 - 1e-4)
    rest = torch.from_numpy(np.random.default_rng(0).normal(0, 0.02, (count, 15, 3))).float()
    tensors = {
        "means": torch.from_numpy(case["means"]),
        "scales": torch.from_numpy(case["scales"]).log(),
        "quats": torch.from_numpy(case["quats"]),
        "opacities": torch.logit(opacities),
        "f_dc": ((torch.from_numpy(case["colors"]) - 0.5) / SH_C0)[:, None, :],
        "f_rest": rest,
    }
    return {name: t.clone().contiguous().requires_grad_() for name, t in tensors.items()}


def camera_of(case: dict[str, np.ndarray]) -> Camera:
    """The case's camera."""
    k = case["K"].astype(np.float64)
    pose = torch.from_numpy(case["viewmat"].astype(np.float64))
    size = (int(case["width"]), int(case["height"]))
    return Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose)


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--reps", type=int, default=15)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--max-alpha", type=float, default=0.999)
    arguments = parser.parse_args()
    threads = configure_threads(arguments.threads)
    with np.load(arguments.case) as file:
        case = dict(file)
    parameters, camera = parameters_of(case), camera_of(case)
    backbone = Vanilla()
    rasterizer = NumbaRasterizer(max_alpha=arguments.max_alpha, near=0.01)
    phase = Phase(STEP, training=True, schedule=Schedule.for_run(30_000))
    state = AdamState()
    # Rates of zero keep the case the same from repetition to repetition at the same cost.
    rates = dict.fromkeys(parameters, 0.0)
    shape = (camera.height, camera.width, 3)
    photo = torch.from_numpy(np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8))
    background = torch.zeros(3)
    marks: dict[str, list[float]] = {"render": [], "loss": [], "backward": [], "adam": []}
    for repetition in range(arguments.reps + 2):
        times = [perf_counter()]
        gaussians = backbone.decode(parameters, camera, phase)
        render = rasterizer.render(gaussians, camera, background)
        times.append(perf_counter())
        loss = photometric_loss(render.image, photo)
        times.append(perf_counter())
        loss.backward()
        times.append(perf_counter())
        adam_step(parameters, {n: t.grad for n, t in parameters.items()}, state, rates)
        times.append(perf_counter())
        for tensor in parameters.values():
            tensor.grad = None
        if repetition >= 2:  # the first ones compile and warm up
            for name, start, end in zip(marks, times, times[1:], strict=False):
                marks[name].append(end - start)
    steps = [sum(parts) for parts in zip(*marks.values(), strict=True)]
    result = {
        "benchmark": "step",
        "case": arguments.case.name,
        "seconds": median(steps),
        **{f"{name}_seconds": median(values) for name, values in marks.items()},
        "reps": arguments.reps,
        "threads": threads,
        "peak_mib": peak_mib(),
        **facts(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
