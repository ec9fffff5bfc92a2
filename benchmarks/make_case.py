"""Make the case file with which rasterizers are timed and checked.

    python benchmarks/make_case.py CASE.npz --garden test_garden.npz
    python benchmarks/make_case.py CASE.npz

With --garden, the result is the case of docs/benchmarks.md. This case uses positions, colours and
the first camera of the garden scene of Mip-NeRF 360, with random sizes, rotations and opacities.
gsplat contains these data for its tests (file assets/test_garden.npz of the public repository
nerfstudio-project/gsplat, Apache-2.0). Without --garden, positions and colours are random. This
case has data of the same kind and size and needs no download, but its times and errors are
different.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

Arrays = dict[str, NDArray[np.generic]]

#: Number of Gaussians in the scene `garden` within [-2, 2] on every axis.
GAUSSIANS = 111_785
WIDTH, HEIGHT, FOCAL = 648, 420, 481.0
LEAST_SCALE, LARGEST_SCALE = 1e-4, 0.02
SEED = 42


def garden(path: Path) -> Arrays:
    """Return points, colours and first camera of gsplat's data, within [-2, 2] on every axis."""
    with np.load(path) as archive:
        means = archive["means3d"].astype(np.float32)
        inside = (np.abs(means) <= 2.0).all(axis=1)
        return {
            "means": means[inside],
            "colors": (archive["colors"][inside] / 255.0).astype(np.float32),
            "viewmat": archive["viewmats"][0].astype(np.float32),
            "K": archive["Ks"][0].astype(np.float32),
            "width": archive["width"],
            "height": archive["height"],
        }


def made_up(gaussians: int) -> Arrays:
    """Return a synthetic table on a lawn: 2/3 of the points on a plane, 1/3 in a ball."""
    rng = np.random.default_rng(SEED)
    ball = gaussians // 3
    lawn = np.column_stack([rng.uniform(-2, 2, (gaussians - ball, 2)), np.zeros(gaussians - ball)])
    direction = rng.normal(size=(ball, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = np.concatenate([lawn, [0.0, 0.0, 0.6] + 0.6 * direction])
    return {
        "means": means.astype(np.float32),
        "colors": rng.uniform(size=(gaussians, 3)).astype(np.float32),
        "viewmat": oblique_camera(),
        "K": np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=np.float32),
        "width": np.array(WIDTH),
        "height": np.array(HEIGHT),
    }


def oblique_camera() -> NDArray[np.float32]:
    """Return the pose [4, 4], world to camera, at distance 2.6 and 35 degrees above the plane."""
    angle = np.deg2rad(35.0)
    down, forward = np.sin(angle), np.cos(angle)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[1, 0, 0], [0, -down, -forward], [0, forward, -down]]
    pose[:3, 3] = [0, 0.2, 2.6]
    return pose


def with_attributes(arrays: Arrays) -> Arrays:
    """Return the case with random sizes, rotations, opacities and image gradient."""
    count = len(arrays["means"])
    shape = (int(arrays["height"]), int(arrays["width"]), 3)
    torch.manual_seed(SEED)
    attributes = {
        "scales": torch.empty((count, 3)).uniform_(LEAST_SCALE, LARGEST_SCALE),
        "quats": normalize(torch.randn((count, 4)), dim=-1),
        "opacities": torch.rand(count),
        "v_image": torch.randn(shape),
    }
    return {**arrays, **{name: tensor.numpy() for name, tensor in attributes.items()}}


def main() -> None:
    """Read the command line and write the case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("case", type=Path, help="the file to write")
    parser.add_argument("--garden", type=Path, help="test_garden.npz of gsplat")
    parser.add_argument(
        "--gaussians", type=int, default=GAUSSIANS, help="number of Gaussians without --garden"
    )
    arguments = parser.parse_args()
    arrays = garden(arguments.garden) if arguments.garden else made_up(arguments.gaussians)
    np.savez_compressed(arguments.case, **with_attributes(arrays))
    print(f"{len(arrays['means']):,} Gaussians in {arguments.case}")


if __name__ == "__main__":
    main()
