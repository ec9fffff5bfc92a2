"""Time a rasterizer, forward and backward, on a fixed case; print one JSON line.

    NUMBA_NUM_THREADS=1 python benchmarks/rasterizer.py CASE.npz [--rasterizer numba] [--reps 30]

A case contains `means`, `quats`, `scales`, `opacities`, `colors`, a camera (`viewmat`, `K`,
`width`, `height`) and `v_image`, the gradient of the loss with respect to the image. Times are
seconds of wall time, as median and minimum over the repetitions. One repetition before the timed
ones compiles the kernels; its time is printed as `first`. `--save` writes the image and the
gradients of sum(image * v_image).
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians, Render
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import build

INPUTS = ("means", "quats", "scales", "opacities", "colors")


def main() -> None:
    """Read the command line, measure, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("case", type=Path)
    parser.add_argument("--rasterizer", default="numba")
    parser.add_argument("--max-alpha", type=float, default=0.999)
    parser.add_argument("--near", type=float, default=0.01)
    parser.add_argument("--dilation", type=float, default=0.3)
    parser.add_argument("--reps", type=int, default=30)
    parser.add_argument("--save", type=Path)
    arguments = parser.parse_args()
    # Use the settings of a run: the same number of threads for torch, and freed memory that is kept
    # for the next step.
    configure_threads()
    with np.load(arguments.case) as archive:
        case = dict(archive)
    options = {key: getattr(arguments, key) for key in ("max_alpha", "near", "dilation")}
    rasterizer = build(Rasterizer, arguments.rasterizer, options)
    tensors = {key: torch.from_numpy(case[key]).requires_grad_() for key in INPUTS}
    forwards, backwards = [], []
    for _ in range(arguments.reps + 1):
        forward, backward, result = draw(rasterizer, tensors, case)
        forwards.append(forward)
        backwards.append(backward)
    if arguments.save is not None:
        save(arguments.save, result, tensors)
    totals = [a + b for a, b in zip(forwards, backwards, strict=True)]
    line = {
        "case": arguments.case.name,
        "rasterizer": arguments.rasterizer,
        **options,
        "gaussians": len(case["means"]),
        **summary("forward", forwards[1:]),
        **summary("backward", backwards[1:]),
        **summary("total", totals[1:]),
        "first": round(totals[0], 3),
        "reps": arguments.reps,
        "peak_mib": peak_mib(),
        **facts(),
    }
    print(json.dumps(line))


def draw(
    rasterizer: Rasterizer, tensors: dict[str, Tensor], case: dict[str, Any]
) -> tuple[float, float, Render]:
    """Render and differentiate once. Return both durations in seconds, and the result."""
    for tensor in tensors.values():
        tensor.grad = None
    v_image = torch.from_numpy(case["v_image"])
    camera = camera_of(case)
    gaussians = Gaussians(
        means=tensors["means"],
        quats=tensors["quats"],
        scales=tensors["scales"],
        opacities=tensors["opacities"],
        colors=tensors["colors"],
    )
    start = time.perf_counter()
    result = rasterizer.render(gaussians, camera, torch.zeros(3))
    middle = time.perf_counter()
    torch.autograd.backward([result.image], [v_image])
    return middle - start, time.perf_counter() - middle, result


def camera_of(case: dict[str, Any]) -> Camera:
    """Return the camera of a case."""
    k = case["K"].astype(np.float64)
    pose = torch.from_numpy(case["viewmat"].astype(np.float64))
    size = int(case["width"]), int(case["height"])
    return Camera(*size, k[0, 0].item(), k[1, 1].item(), k[0, 2].item(), k[1, 2].item(), pose)


def summary(name: str, seconds: list[float]) -> dict[str, float]:
    """Return median and minimum of durations in seconds."""
    return {
        name: round(statistics.median(seconds), 5),
        f"{name}_min": round(min(seconds), 5),
    }


def save(path: Path, result: Render, tensors: dict[str, Tensor]) -> None:
    """Write image, alpha and the gradients of the inputs to an npz file."""
    arrays = {"image": result.image.detach().numpy(), "alpha": result.alpha.detach().numpy()}
    for name, tensor in tensors.items():
        if tensor.grad is None:
            raise RuntimeError(f"{name} got no gradient")
        arrays[f"v_{name}"] = tensor.grad.numpy()
    np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
