"""An initializer that adds a dome of points over the scene, for parts without SfM points."""

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import Field, Initializer, MorePoints, Scene


class Sky(Initializer):
    """Blue points on the upper half of a sphere around the cameras; z points up."""

    radius: float = Field(10.0, gt=0.0, description="radius of the dome, scene extents")
    count: int = Field(200, ge=1, description="points")

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        # Place the points on a spiral with equal areas; neighbouring points differ by the golden
        # angle.
        height = (np.arange(self.count) + 0.5) / self.count
        angle = np.arange(self.count) * np.pi * (3.0 - np.sqrt(5.0))
        flat = np.sqrt(1.0 - height**2)
        dome = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
        return MorePoints(
            positions=scene.centers.mean(axis=0) + self.radius * dome,
            colors=np.tile(np.array([135, 178, 220], dtype=np.uint8), (self.count, 1)),
            sizes=np.full(self.count, self.radius / np.sqrt(self.count)),
            opacities=np.full(self.count, 0.9),
        )
