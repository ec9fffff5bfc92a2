"""The initializer slot: a component provides the points for the first primitives."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.component import Component, answered
from crossgrad_core.contract.scene import Scene


@dataclass(frozen=True, eq=False)
class MorePoints:
    """Points that are added to the points of the scene.

    Attributes:
        positions: [N, 3] float64, local frame.
        colors: [N, 3] uint8 RGB.
        sizes: [N] float64, local units: standard deviation of the Gaussian of a point, if the
            backbone makes Gaussians from points. NaN selects a size from the distance to the
            neighbours, as for the points of the scene.
        opacities: [N] float64 in (0, 1): opacity of the Gaussian of each point. NaN selects the
            value of the backbone.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    sizes: NDArray[np.float64]
    opacities: NDArray[np.float64]


class Initializer(Component):
    """A method that adds points to scenes with too few points; repeated calls give the same points.

    An initializer is used only in runs that start from the scene's own points (`--init points`).

    Attributes:
        alone: True if the initializer can make points for a scene without points. In a scene
            without points, the initializer must then make points or raise an error.
    """

    slot: ClassVar[str] = "initializers"
    alone: ClassVar[bool] = False

    @abstractmethod
    def more_points(self, scene: Scene) -> MorePoints | None:
        """Return the points to add; None to add no points."""

    def messages(self, scene: Scene) -> tuple[str, ...]:
        """Return messages for the user about the added points; called for new runs only."""
        return ()

    def begun(self, scene: Scene) -> Scene:
        """Return the scene with the new points appended; existing points keep their indices."""
        answer = self.more_points(scene)
        if answer is None:
            return scene
        more = answered(answer, MorePoints, self, "more_points")
        if not len(more.positions):
            return scene
        unknown = np.full(len(scene.points), np.nan)
        return replace(
            scene,
            points=np.concatenate([scene.points, more.positions]),
            point_colors=np.concatenate([scene.point_colors, more.colors]),
            point_sizes=np.concatenate([unknown, more.sizes]),
            point_opacities=np.concatenate([unknown, more.opacities]),
        )
