"""Compare a fast rasterizer with the float64 reference on a fixed case, as one JSON line.

    python benchmarks/accuracy.py CASE.npz [--rasterizer numba]

A case contains `means`, `quats`, `scales`, `opacities`, `colors`, a camera (`viewmat`, `K`,
`width`, `height`) and `v_image`, the gradient of the loss with respect to the image.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from _machine import facts, peak_mib
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.registry.entries import build

INPUTS = ("means", "quats", "scales", "opacities", "colors")
GRADIENTS = (*INPUTS, "mean_gradient", "abs_gradient")


def main() -> None:
    """Read the command line, measure, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("case", type=Path)
    parser.add_argument("--rasterizer", default="numba")
    parser.add_argument("--max-alpha", type=float, default=0.999)
    parser.add_argument("--near", type=float, default=0.01)
    arguments = parser.parse_args()
    with np.load(arguments.case) as archive:
        case = dict(archive)
    options = {"max_alpha": arguments.max_alpha, "near": arguments.near}
    start = time.perf_counter()
    exact = draw("torch", case, torch.float64, options)
    seconds = time.perf_counter() - start
    fast = draw(arguments.rasterizer, case, torch.float32, options)
    line = {
        "case": arguments.case.name,
        "rasterizer": arguments.rasterizer,
        **options,
        "gaussians": len(case["means"]),
        "pairs": int(exact["pixels"].sum()),
        **{f"{name}_mean_abs": mean_abs(fast[name], exact[name]) for name in ("image", "alpha")},
        "image_max_abs": float((fast["image"].double() - exact["image"]).abs().max()),
        "pixels_differing": int((fast["pixels"] != exact["pixels"]).sum()),
        **{f"{name}_relative_l2": relative_l2(fast[name], exact[name]) for name in GRADIENTS},
        "reference_seconds": round(seconds, 2),
        "peak_mib": peak_mib(),
        **facts(),
    }
    print(json.dumps(line))


def draw(
    name: str, case: dict[str, Any], dtype: torch.dtype, options: dict[str, float]
) -> dict[str, Tensor]:
    """Render a case. Return image, alpha, pixel counts and each gradient of `GRADIENTS`."""
    rasterizer = build(Rasterizer, name, options)
    tensors = [torch.from_numpy(case[key]).to(dtype).requires_grad_() for key in INPUTS]
    outputs = frozenset({"pixels", "abs_gradient"})
    background = torch.zeros(3, dtype=dtype)
    result = rasterizer.render(Gaussians(*tensors), camera_of(case), background, outputs)
    torch.autograd.backward([result.image], [torch.from_numpy(case["v_image"]).to(dtype)])
    found = dict(zip(INPUTS, (tensor.grad for tensor in tensors), strict=True))
    found |= {"image": result.image.detach(), "alpha": result.alpha.detach()}
    found |= {key: getattr(result.screen, key) for key in ("pixels", *GRADIENTS[len(INPUTS) :])}
    missing = [key for key, value in found.items() if value is None]
    if missing:
        raise RuntimeError(f"{name} left out {', '.join(missing)}")
    return cast("dict[str, Tensor]", found)


def camera_of(case: dict[str, Any]) -> Camera:
    """Return the camera of a case."""
    k = case["K"].astype(np.float64)
    pose = torch.from_numpy(case["viewmat"].astype(np.float64))
    size = int(case["width"]), int(case["height"])
    return Camera(*size, k[0, 0].item(), k[1, 1].item(), k[0, 2].item(), k[1, 2].item(), pose)


def mean_abs(found: Tensor, expected: Tensor) -> float:
    """Return the mean absolute difference."""
    return float((found.double() - expected).abs().mean())


def relative_l2(found: Tensor, expected: Tensor) -> float:
    """Return the norm of the difference divided by the norm of the expected tensor."""
    return float((found.double() - expected).norm() / expected.norm())


if __name__ == "__main__":
    main()
