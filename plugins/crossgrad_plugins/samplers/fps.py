"""Epochs whose views are in farthest-point order of the camera poses."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import PluginState, SampleContext, Sampler, ViewCounts, ViewSample
from crossgrad_plugins.samplers.draws import EpochOrder, drawn, require_enough, training_views


class FarthestPoint(Sampler):
    """Draws every training view once per epoch, in farthest-point order.

    Each next view is as far as possible in pose space from the views before it. An epoch starts at
    a random view. A step takes the next K views of the order. A point of pose space consists of the
    camera centre and of the unit viewing direction times `direction_weight`. Distances are
    Euclidean. Camera centres are divided by their root mean square distance from the mean centre;
    outlying cameras are left out of this mean and distance. An order lasts for a whole epoch,
    because a new order in each step would render the outermost cameras far more often than other
    cameras.

    Source: farthest-point sampling, Eldar et al. 1997; the pose space was developed for crossgrad.
    """

    views: ClassVar[ViewCounts] = ViewCounts()
    default_views: ClassVar[int] = 2
    reads_groups: ClassVar[bool] = False

    direction_weight: float = Field(
        1.0, ge=0.0, description="weight of the viewing direction relative to the position"
    )

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        views = training_views(context)
        require_enough(len(views), context.views_per_step)
        epoch_order = EpochOrder.from_json(state.values.get("deck"))

        def renew() -> list[int]:
            start = int(context.rng.integers(len(views)))
            return farthest_point_order(self._poses(context), start)

        chosen, epoch_order = epoch_order.next(context.views_per_step, renew)
        return drawn(chosen, context), PluginState({"deck": epoch_order.to_json()})

    def _poses(self, context: SampleContext) -> NDArray[np.float64]:
        """Return [N, 6] the positions of the training cameras in pose space."""
        scene = context.scene
        centers = context.centers - scene.middle
        robust = scene.robust_centers - scene.middle
        radius = float(np.sqrt((robust**2).sum(axis=1).mean()))
        rows = [view.camera.world_to_camera[2, :3].numpy() for view in scene.train_views]
        directions = np.stack(rows).astype(np.float64)
        # If all cameras have one position, only their directions differ.
        scaled = centers / radius if radius > 0.0 else np.zeros_like(centers)
        return np.concatenate([scaled, self.direction_weight * directions], axis=1)


def farthest_point_order(points: NDArray[np.float64], start: int) -> list[int]:
    """Return an order of points [N, D] that starts with `start`.

    Each next point is the farthest from all earlier points. Among equally far points, the lowest
    index is first.
    """
    order = [start]
    nearest = np.full(len(points), np.inf)
    for _ in range(len(points) - 1):
        last = points[order[-1]]
        nearest = np.minimum(nearest, ((points - last) ** 2).sum(axis=1))
        nearest[order[-1]] = -1.0
        order.append(int(nearest.argmax()))
    return order
