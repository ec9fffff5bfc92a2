"""A bound on sizes: Gaussians are not much larger than they are far from cameras beside them.

A splat is drawn as if its Gaussian were small for its distance. One that is not spreads over what a
camera sees that has it at its side, or behind it, whether or not a training photo shows that
(docs/floaters.md). Cameras that have it in their photo say themselves how large it is. The rule is
ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass
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
#: Scene extents. Smaller Gaussians stay, which most are, and hardly one of them is above the bound.
LEAST: Final = 0.01
#: Distances that are worked out at once.
_AT_ONCE: Final = 2**20


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
    largest, cameras = scales.amax(dim=1), _Cameras.of(setup.scene, positions)
    rows = (largest > log(LEAST)).nonzero().squeeze(1)
    rows = rows[cameras.may_be_near(positions[rows], torch.exp(largest[rows]) / bound)]
    most = torch.log(bound * cameras.nearest_beside(positions[rows])).clamp_min(log(LEAST))
    # What has diverged is for the checks to find.
    above = (largest[rows] > most) & largest[rows].isfinite()
    rows, most = rows[above], most[above]
    scales[rows] = torch.minimum(scales[rows], most[:, None].to(scales))


@dataclass(frozen=True)
class _Cameras:
    """The V training cameras as tensors.

    Attributes:
        centers: [V, 3], local frame.
        poses: [V, 3, 4], world to camera.
        inner: [V, 6] focal lengths, principal point and size, pixels.
    """

    centers: Tensor
    poses: Tensor
    inner: Tensor

    @classmethod
    def of(cls, scene: Scene, like: Tensor) -> "_Cameras":
        """Those of a scene, of the type and on the device of a tensor."""
        cameras = [view.camera for view in scene.train_views]
        inner = [(each.fx, each.fy, each.cx, each.cy, each.width, each.height) for each in cameras]
        return cls(
            torch.from_numpy(scene.centers).to(like),
            torch.stack([each.world_to_camera[:3] for each in cameras]).to(like),
            like.new_tensor(inner),
        )

    def may_be_near(self, positions: Tensor, distances: Tensor) -> Tensor:
        """[N] bool: all positions [N, 3] that are nearer to any camera, and few others.

        Products tell that fastest. They lose what is small of two large positions, so that as much
        is taken off.
        """
        squares, of_centers = (each.square().sum(dim=1) for each in (positions, self.centers))
        nearest = [
            torch.addmm(of_centers, some, self.centers.T, alpha=-2.0).amin(dim=1)
            for some in torch.split(positions, max(1, _AT_ONCE // len(self.centers)))
        ]
        lost = 16.0 * torch.finfo(positions.dtype).eps * (squares + of_centers.amax())
        return distances.square() > squares + torch.cat(nearest) - lost

    def nearest_beside(self, positions: Tensor) -> Tensor:
        """[N] distance to the nearest camera that has a position [N, 3] at its side, or behind it.

        Infinite for what all photos show.
        """
        found = [positions.new_zeros(0)]
        for some in torch.split(positions, max(1, _AT_ONCE // (8 * len(self.centers)))):
            apart = torch.cdist(some, self.centers, compute_mode="donot_use_mm_for_euclid_dist")
            found.append(apart.masked_fill(self._show(some), torch.inf).amin(dim=1))
        return torch.cat(found)

    def _show(self, positions: Tensor) -> Tensor:
        """[N, V] bool, whether each position [N, 3] lies in each photo."""
        fx, fy, cx, cy, width, height = self.inner.unbind(1)
        turned = torch.einsum("vij,nj->nvi", self.poses[:, :, :3], positions)
        x, y, depth = (turned + self.poses[:, :, 3]).unbind(2)
        across, down = fx * x + cx * depth, fy * y + cy * depth
        within = (across >= 0) & (across <= width * depth) & (down >= 0) & (down <= height * depth)
        return within & (depth > 0)
