"""A bound on sizes: Gaussians are not much larger than they are far from cameras beside them.

A splat is drawn as if its Gaussian were small for its distance. One that is not spreads over what a
camera sees that has it at its side, or behind it, whether or not a training photo shows that
(docs/floaters.md). Cameras that have it in their photo say themselves how large it is. The rule is
ours.
"""

from collections.abc import Iterator
from math import log
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.contract.scene import Scene
from crossgrad_core.training.rates import gaussians_of, is_short
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Largest standard deviation, of the distance to the nearest camera that has it at its side.
BOUND: Final = 0.5
#: Sizes are looked at once in so many steps.
EVERY: Final = 50
#: Scene extents. Hardly a smaller Gaussian is above the bound, and most Gaussians are smaller.
LEAST: Final = 0.01
#: Distances that are worked out at once.
_AT_ONCE: Final = 2**22


def size_bound_of(setup: Setup) -> float:
    """The bound of a run; 0 where sizes have none.

    By default runs have none that are as long as the published ones or have their rules. Sizes that
    are not trained stay as they are.
    """
    config = setup.config
    if not bounds_sizes(setup):
        return 0.0
    if config.size_bound is not None:
        return config.size_bound
    return BOUND if is_short(config, setup.schedule) else 0.0


def bounds_sizes(setup: Setup) -> bool:
    """Whether a run could bound sizes: primitives are Gaussians with axes that learn."""
    names = gaussians_of(setup)
    learning = (block for block in setup.trained_blocks if block.lr.initial > 0.0)
    return names is not None and names[1] in {name for each in learning for name in each.tensors}


def note_on_sizes(setup: Setup) -> Iterator[str]:
    """That sizes are bounded, where the run did not ask for it."""
    if setup.config.size_bound is None and (bound := size_bound_of(setup)):
        yield (
            f"standard deviations are at most {bound:g} of the distance to the nearest training "
            "camera that has a Gaussian at its side (--set size_bound=0: no bound, as published)"
        )


def bound_sizes(setup: Setup, state: TrainState) -> None:
    """Shortens axes that are too long, in place, in the steps in which sizes are looked at."""
    names = gaussians_of(setup)
    if state.step % EVERY or names is None or not (bound := size_bound_of(setup)):
        return
    positions, scales, _ = (state.tensors[each].detach() for each in names)
    largest = scales.amax(dim=1)
    rows = (largest > log(LEAST)).nonzero().squeeze(1)
    # Most Gaussians are small for their distance to whatever camera.
    for shown_counts in (True, False):
        distances = _nearest(setup.scene, positions[rows], shown_counts=shown_counts)
        most = torch.log(bound * distances)
        above = largest[rows] > most
        rows, most = rows[above], most[above]
    scales[rows] = torch.minimum(scales[rows], most[:, None])


def _nearest(scene: Scene, positions: Tensor, *, shown_counts: bool) -> Tensor:
    """[N] distance of each position to the nearest training camera; never 0.

    Args:
        scene: The scene.
        positions: [N, 3], local frame.
        shown_counts: Whether cameras count in whose photo the position lies. Where these are all
            cameras, and do not count, the distance is infinite.
    """
    centers = torch.from_numpy(scene.centers).to(positions)
    found = [positions.new_zeros(0)]
    for some in torch.split(positions, max(1, _AT_ONCE // len(centers))):
        # Without products, which lose what is small of two large positions.
        apart = torch.cdist(some, centers, compute_mode="donot_use_mm_for_euclid_dist")
        if not shown_counts:
            apart[_shown(scene, some)] = torch.inf
        found.append(apart.amin(dim=1))
    # Nearer than that the positions themselves are rounded.
    return torch.cat(found).clamp_min(torch.finfo(positions.dtype).eps)


def _shown(scene: Scene, positions: Tensor) -> Tensor:
    """[N, V] bool, whether each position [N, 3] lies in each training photo."""
    cameras = [view.camera for view in scene.train_views]
    poses = torch.stack([each.world_to_camera for each in cameras]).to(positions)
    inner = [(each.fx, each.fy, each.cx, each.cy, each.width, each.height) for each in cameras]
    fx, fy, cx, cy, width, height = positions.new_tensor(inner).unbind(1)
    local = torch.einsum("vij,nj->nvi", poses[:, :3, :3], positions) + poses[:, :3, 3]
    x, y, depth = local.unbind(2)
    across, down = fx * x + cx * depth, fy * y + cy * depth
    within = (across >= 0) & (across <= width * depth) & (down >= 0) & (down <= height * depth)
    return within & (depth > 0)
