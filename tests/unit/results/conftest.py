"""Small results to write and to read back."""

import numpy as np
import pytest
import torch
from support.figures import FIGURES, of

from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.evaluation.result import EvaluationResult, summarised
from crossgrad_core.run.results.metrics_csv import Totals


class ArrayPhoto:
    """A photo that is in memory."""

    def __init__(self, image: torch.Tensor, mask: torch.Tensor | None) -> None:
        self._image, self._mask = image, mask

    def image(self) -> torch.Tensor:
        return self._image

    def mask(self) -> torch.Tensor | None:
        return self._mask


def make_view(name: str, regime: str, width: int = 24, height: int = 16, seed: int = 0) -> View:
    rng = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (height, width, 3), generator=rng, dtype=torch.uint8)
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(width, height, 20.0, 20.0, width / 2, height / 2, pose)
    return View(name, camera, ArrayPhoto(image, None), regime, np.empty(0, dtype=np.int64))


@pytest.fixture(name="make_view")
def _make_view():
    return make_view


@pytest.fixture(name="result")
def _result() -> EvaluationResult:
    return summarised(
        [
            of("near/1.jpg", "near", 20.0, 0.5, 0.6, None),
            of("near/2.jpg", "near", 22.0, 0.7, 0.8, None),
            of("far/1.jpg", "far", 30.0, 0.9, 0.95, None),
        ],
        FIGURES,
    )


@pytest.fixture(name="empty")
def _empty() -> EvaluationResult:
    return summarised([], FIGURES)


@pytest.fixture(name="totals")
def _totals() -> Totals:
    return Totals(
        step=700,
        views=1400,
        backward_passes=1400,
        train_seconds=38.2104999,
        primitives=111_785,
        peak_memory_mib=1523.04,
        loss=0.061234567890123456,
        cpu_seconds=36.7504,
        peak_primitives=120_000,
    )
