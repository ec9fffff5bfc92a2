"""Measure the median seconds of a whole training step on a fixed case, as one JSON line.

A step has the parts of a step in a run: decoding with SH degree 3, rendering, loss against a random
photo, backward pass, and one Adam step. The Adam step of positions is scaled along the axes of
their Gaussians. The Adam step of colours updates only the drawn rows, after their deferred updates
are done. Each timed step follows a step with another view, rotated by `--turn`, so that some rows
have deferred updates. With two threads, the Adam step of colours continues during the next step.
The time `render` of the next step then includes the end of the Adam step. With `--sh-every`, this
does not happen, because two kinds of steps alternate.

    python benchmarks/step.py CASE.npz [--reps N] [--threads N] [--max-alpha A] [--turn DEGREES]
        [--sh-every N]

With `--sh-every N`, SH bands above the first are updated in only one of N steps. The printed times
are then means over N steps, computed from the medians of both kinds of steps.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.contract.gaussians import OnDemand
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.training.adam.adam import adam_step, counted
from crossgrad_core.training.adam.axes import step_along_axes
from crossgrad_core.training.adam.late import Late
from crossgrad_plugins.losses.l1_ssim import photometric_loss
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer

#: At this step of the published schedule, SH degree 3 is active.
STEP = 5000


def parameters_of(case: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """Return the case as vanilla parameters, with small random SH coefficients of higher bands."""
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


def camera_of(case: dict[str, np.ndarray], degrees: float) -> Camera:
    """Return the camera of the case, rotated about the camera's vertical axis."""
    k = case["K"].astype(np.float64)
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    pose = torch.from_numpy(turn @ case["viewmat"].astype(np.float64))
    size = (int(case["width"]), int(case["height"]))
    return Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose)


class Trainer:
    """Parameters and the state of their optimizer, for single training steps."""

    def __init__(self, case: dict[str, np.ndarray], max_alpha: float) -> None:
        self.parameters = parameters_of(case)
        self.backbone = Vanilla()
        self.rasterizer = NumbaRasterizer(max_alpha=max_alpha, near=0.01)
        self.phase = Phase(STEP, training=True, schedule=Schedule.for_run(30_000))
        self.state, self.late = AdamState(), Late()
        #: True if every step must be finished before the next step starts.
        self.apart = False
        # Set the learning rates to zero. All repetitions then have the same parameters and the same
        # cost.
        self.rates = dict.fromkeys(self.parameters, 0.0)

    def step(self, camera: Camera, photo: Tensor, *, rests: bool) -> Iterator[str]:
        """Take a step, and yield the name of each part when the part is finished."""
        resting = {name for b in self.backbone.trained_blocks() if b.rests for name in b.tensors}
        tensors = {
            name: tensor.detach() if rests and name in resting else tensor
            for name, tensor in self.parameters.items()
        }
        gaussians = self.backbone.decode(tensors, camera, self.phase)
        demand = OnDemand(frozenset(self.backbone.passthrough), self._bring)
        gaussians = replace(gaussians, on_demand=demand)
        render = self.rasterizer.render(gaussians, camera, torch.zeros(3))
        yield "render"
        loss = photometric_loss(render.image, photo)
        yield "loss"
        loss.backward()
        yield "backward"
        self._optimize()
        if self.apart:
            self.late.finish()
        yield "adam"

    def _bring(self, rows: Tensor | None) -> None:
        for name in self.backbone.passthrough.values():
            self.late.catch_up(name, self.parameters[name], self.state, rows)

    def _optimize(self) -> None:
        gradients = {name: tensor.grad for name, tensor in self.parameters.items()}
        sparse_rows = {name: gradients.pop(name) for name in self.backbone.passthrough.values()}
        moved = torch.empty_like(self.parameters["means"])
        tensors = {**self.parameters, "means": moved}
        adam_step(tensors, gradients, self.state, self.rates, from_zero={"means"})
        axes = [self.parameters[name] for name in self.backbone.axes]
        step_along_axes(self.parameters["means"], moved, *axes)
        for name, gradient in sparse_rows.items():
            if gradient is None:
                continue
            param = self.parameters[name]
            step = counted(name, param, self.state, 0.0, AdamRule(), 1.0)
            self.late.step(name, param, gradient, self.state, step)
        for tensor in self.parameters.values():
            tensor.grad = None


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--reps", type=int, default=15)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--max-alpha", type=float, default=0.999)
    parser.add_argument("--turn", type=float, default=30.0, help="degrees between the two views")
    parser.add_argument("--sh-every", type=int, default=1, metavar="N")
    arguments = parser.parse_args()
    threads = configure_threads(arguments.threads)
    with np.load(arguments.case) as file:
        case = dict(file)
    trainer = Trainer(case, arguments.max_alpha)
    trainer.apart = arguments.sh_every > 1
    views = camera_of(case, arguments.turn), camera_of(case, 0.0)
    shape = (views[0].height, views[0].width, 3)
    photo = torch.from_numpy(np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8))
    every = arguments.sh_every
    parts = ("render", "loss", "backward", "adam")
    # Times of steps that update all SH bands, and of steps that skip the higher bands.
    marks: list[dict[str, list[float]]] = [{name: [] for name in parts} for _ in range(2)]
    for repetition in range(2 * (arguments.reps + 2) * min(every, 2)):
        # Before a step that skips bands, take a step that renders the other view and updates these
        # bands.
        rests = every > 1 and repetition % 4 == 3
        start = perf_counter()
        for name in trainer.step(views[repetition % 2], photo, rests=rests):
            end = perf_counter()
            # Do not measure the first steps, because they compile kernels.
            if repetition >= 4 * min(every, 2) and repetition % 2:
                marks[rests][name].append(end - start)
            start = perf_counter()
    shares = [(1 / every, marks[0])] + [(1 - 1 / every, marks[1])] * (every > 1)
    each = {name: sum(share * median(kind[name]) for share, kind in shares) for name in parts}
    whole = [(share, [sum(s) for s in zip(*kind.values(), strict=True)]) for share, kind in shares]
    result = {
        "benchmark": "step",
        "case": arguments.case.name,
        "seconds": sum(share * median(steps) for share, steps in whole),
        **{f"{name}_seconds": seconds for name, seconds in each.items()},
        "sh_every": every,
        "reps": arguments.reps,
        "threads": threads,
        "peak_mib": peak_mib(),
        **facts(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
