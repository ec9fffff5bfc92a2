"""Random Gaussians of any degree, and readers of files with Gaussians."""

import json
import struct
from pathlib import Path

import numpy as np
import torch

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.slots.exporter import ExportContent

SAME = Similarity(np.zeros(3), 1.0)
UTM = Similarity(np.array([355_142.5, 5_812_377.25, 81.0]), 1 / 60)


def gaussians(degree: int = 3, count: int = 500, seed: int = 0) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=rng)

    return Gaussians(
        means=5 * numbers(3),
        quats=numbers(4),
        scales=torch.exp(numbers(3) - 2),
        opacities=torch.sigmoid(2 * numbers()),
        sh_dc=numbers(1, 3).clamp(-3, 3),
        sh_rest=0.2 * numbers((degree + 1) ** 2 - 1, 3) if degree else None,
        sh_degree=degree,
    )


def content(given: Gaussians, similarity: Similarity = SAME, **facts) -> ExportContent:
    return ExportContent(given, similarity, comments=("a comment",), **facts)


def rotation_error(quats, others) -> float:
    """Largest angle in radians between rotations [N, 4] wxyz."""
    unit = [np.asarray(q) / np.linalg.norm(q, axis=1, keepdims=True) for q in (quats, others)]
    cosines = np.abs((unit[0] * unit[1]).sum(axis=1)).clip(max=1)
    return float(2 * np.arccos(cosines).max())


def glb_of(path: Path) -> tuple[dict, bytes]:
    raw = path.read_bytes()
    assert struct.unpack("<4sII", raw[:12]) == (b"glTF", 2, len(raw))
    length = struct.unpack("<I", raw[12:16])[0]
    assert raw[16:20] == b"JSON" and raw[24 + length : 28 + length] == b"BIN\0"
    return json.loads(raw[20 : 20 + length]), raw[28 + length :]
