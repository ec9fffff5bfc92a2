"""Time the photometric loss with its gradient, fused and in torch, as one JSON line.

    python benchmarks/loss.py [--width W] [--height H] [--reps N] [--threads N] [--masked]

Peak memory is measured for the whole process, after the fused runs and again after torch's runs.
"""

import argparse
import json
from collections.abc import Callable
from statistics import median
from time import perf_counter

import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_core.numerics.threads import configure_threads
from crossgrad_plugins.losses.l1_ssim import photometric_loss
from crossgrad_plugins.losses.photometric.reference import l1_ssim_loss


def timed(loss: Callable[[Tensor], Tensor], image: Tensor, reps: int) -> list[float]:
    """Return the seconds of `reps` forward and backward passes, after one warm-up pass."""
    seconds = []
    for _ in range(reps + 1):
        leaf = image.clone().requires_grad_()
        start = perf_counter()
        loss(leaf).backward()
        seconds.append(perf_counter() - start)
    return seconds[1:]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=648)
    parser.add_argument("--height", type=int, default=420)
    parser.add_argument("--reps", type=int, default=30)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--masked", action="store_true")
    arguments = parser.parse_args()
    configure_threads(arguments.threads)
    generator = torch.Generator().manual_seed(0)
    shape = (arguments.height, arguments.width, 3)
    photo = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    image = torch.rand(shape, generator=generator)
    mask = torch.rand(shape[:2], generator=generator) < 0.7 if arguments.masked else None
    fused = timed(lambda x: photometric_loss(x, photo, mask), image, arguments.reps)
    fused_peak = peak_mib()
    reference = timed(lambda x: l1_ssim_loss(x, photo, mask), image, max(3, arguments.reps // 6))
    line = {
        "benchmark": "loss",
        "width": arguments.width,
        "height": arguments.height,
        "masked": arguments.masked,
        "fused_seconds": median(fused),
        "fused_seconds_min": min(fused),
        "torch_seconds": median(reference),
        "torch_seconds_min": min(reference),
        "ratio": median(reference) / median(fused),
        "peak_mib": fused_peak,
        "peak_mib_torch": peak_mib(),
        **facts(),
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
