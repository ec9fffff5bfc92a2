"""Measure errors of float32 on extreme parameters, compared with float64, as a Markdown table.

    python benchmarks/extremes.py [BACKBONE ...] [--crowd 20000]

The image error is the largest difference in a channel of a pixel. The gradient error is the largest
relative L2 error of a parameter tensor. Both errors compare rasterizer `numba` in float32 with
rasterizer `torch` in float64.
"""

import argparse
import json

import torch
from _machine import facts
from support.extremes import cases, jittered, outcome

from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.fixtures import sample_camera
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer


def cell(backbone: Backbone, case: str, crowd: int) -> str:
    """Return the image error and the gradient error of a case."""
    extreme = cases(crowd)[case](jittered(backbone), sample_camera())
    exact = outcome(backbone, TorchRasterizer(), extreme, torch.float64)
    found = outcome(backbone, NumbaRasterizer(), extreme, torch.float32)
    if not (exact.finite and found.finite):
        return "not finite"
    return f"{found.image_error(exact):.0e} / {found.gradient_error(exact):.0e}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("backbones", nargs="*", help="names; default: all installed")
    parser.add_argument("--crowd", type=int, default=20_000)
    arguments = parser.parse_args()
    names = arguments.backbones or sorted(entries("backbones"))
    print("| case | " + " | ".join(names) + " |")
    print("|" + "---|" * (len(names) + 1))
    models = [build(Backbone, name, {}) for name in names]
    for case in cases(arguments.crowd):
        cells = [cell(model, case, arguments.crowd) for model in models]
        print(f"| {case} | " + " | ".join(cells) + " |", flush=True)
    print(f"\n{json.dumps(facts())}")


if __name__ == "__main__":
    main()
