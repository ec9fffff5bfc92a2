"""Print the median seconds of an Adam step on the tensors of vanilla 3DGS, as one JSON line.

    python benchmarks/adam.py [--gaussians N] [--reps N] [--threads N]

The optimizers take turns, so that other work on the machine affects all of them equally.
"""

import argparse
import json
from collections.abc import Callable
from statistics import median
from time import perf_counter

import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_core.contract.blocks import AdamState
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.training.adam.adam import adam_step

FLOATS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "f_dc": 3, "f_rest": 45}


def tensors(gaussians: int, seed: int, scale: float) -> dict[str, Tensor]:
    """Return normal random tensors with the shapes of the vanilla backbone's tensors."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: scale * torch.randn(gaussians, floats, generator=generator)
        for name, floats in FLOATS.items()
    }


def ours(params: dict[str, Tensor], grads: dict[str, Tensor]) -> Callable[[], object]:
    """Return a function that takes a step of `adam_step`."""
    state, rates = AdamState(), dict.fromkeys(params, 1e-3)
    return lambda: adam_step(params, grads, state, rates)


def theirs(
    params: dict[str, Tensor], grads: dict[str, Tensor], *, fused: bool
) -> Callable[[], object]:
    """Return a function that takes a step of `torch.optim.Adam`, fused or foreach."""
    for name, param in params.items():
        param.requires_grad_()
        param.grad = grads[name]
    groups = [{"params": [param], "lr": 1e-3} for param in params.values()]
    return torch.optim.Adam(groups, eps=1e-15, fused=fused, foreach=not fused).step


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=111_785)
    parser.add_argument("--reps", type=int, default=30)
    parser.add_argument("--threads", type=int, default=None)
    arguments = parser.parse_args()
    configure_threads(arguments.threads)
    grads = tensors(arguments.gaussians, 0, 1e-4)
    steps = {
        "ours": ours(tensors(arguments.gaussians, 1, 1.0), grads),
        "torch_fused": theirs(tensors(arguments.gaussians, 1, 1.0), grads, fused=True),
        "torch_foreach": theirs(tensors(arguments.gaussians, 1, 1.0), grads, fused=False),
    }
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(arguments.reps + 1):
        for name, step in steps.items():
            start = perf_counter()
            step()
            seconds[name].append(perf_counter() - start)
    medians = {name: median(values[1:]) for name, values in seconds.items()}
    line = {
        "benchmark": "adam",
        "parameters": sum(grad.numel() for grad in grads.values()),
        **{f"{name}_seconds": value for name, value in medians.items()},
        **{f"{name}_seconds_min": min(values[1:]) for name, values in seconds.items()},
        "ratio_fused": medians["torch_fused"] / medians["ours"],
        "ratio_foreach": medians["torch_foreach"] / medians["ours"],
        "peak_mib": peak_mib(),
        **facts(),
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
