"""The start slot: the points that the first primitives are made of."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.component import Component, answered
from crossgrad_core.contract.scene import Scene


@dataclass(frozen=True, eq=False)
class MorePoints:
    """Points beside those of the scene.

    Attributes:
        positions: [N, 3] float64, local frame.
        colors: [N, 3] uint8 RGB.
        sizes: [N] float64, local units: standard deviation of the Gaussian that a point becomes,
            where a backbone makes Gaussians of points. NaN takes it from the distance to the
            neighbours, as for the points of the scene.
        opacities: [N] float64 in (0, 1): its opacity, likewise. NaN takes the backbone's own.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    sizes: NDArray[np.float64]
    opacities: NDArray[np.float64]


class Initializer(Component):
    """Adds points where a scene has too few to begin with; asked once and again, it answers alike.

    Only runs that start from the scene's own points (`--init points`) ask it.

    Attributes:
        alone: Whether it has points for a scene without any; it then raises where it finds none.
    """

    slot: ClassVar[str] = "initializers"
    alone: ClassVar[bool] = False

    @abstractmethod
    def more_points(self, scene: Scene) -> MorePoints | None:
        """The points to add; None for none."""

    def messages(self, scene: Scene) -> tuple[str, ...]:
        """What the user should know about them; asked of new runs only."""
        return ()

    def begun(self, scene: Scene) -> Scene:
        """The scene with the added points behind its own, whose indices stay what they are."""
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
