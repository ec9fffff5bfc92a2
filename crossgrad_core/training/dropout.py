"""Gaussians left out of training views at random, so that few photos are not learnt by heart.

Source: DropGaussian (Park et al. 2025), whose share grows with the steps; that it stays, and where
it is used, is ours (docs/few-photos.md).
"""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Scene, is_in_image
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: The random stream of what is left out.
STREAM: Final = "dropout"
#: Points that are looked at, spread over all.
_POINTS: Final = 1000


def photos_per_point(scene: Scene) -> float:
    """In how many training photos an SfM point lies, seen or hidden: the median; 0 without any."""
    points = scene.points[:: -(-len(scene.points) // _POINTS) or 1]
    counts = np.zeros(len(points), np.int64)
    for view in scene.train_views:
        counts += is_in_image(view.camera, points)
    shown = counts[counts > 0]
    return float(np.median(shown)) if len(shown) else 0.0


def dropped(setup: Setup, state: TrainState, gaussians: Gaussians) -> Gaussians:
    """What a training view is drawn from: the others are as much more opaque for it."""
    share = setup.numbers.dropout
    if not share:
        return gaussians
    draws = _draws(state.rngs[STREAM], len(gaussians), gaussians.opacities.device)
    raised = gaussians.opacities * ((draws >= share) / (1.0 - share))
    # Cut off at 1, but not its gradient: what is nearly opaque could never fade.
    return replace(gaussians, opacities=raised - (raised.detach() - 1.0).clamp(min=0.0))


def _draws(rng: np.random.Generator, count: int, device: torch.device) -> Tensor:
    """[N] uniform in [0, 1), drawn on the device: the CPU takes milliseconds for a million."""
    if device.type == "cpu":
        return torch.from_numpy(rng.random(count, dtype=np.float32))
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 63)))
    return torch.rand(count, generator=generator, device=device)
