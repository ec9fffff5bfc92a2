"""Points beside those of the scene, for a run to start from."""

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import Field, MorePoints, Scene, Start


class Template(Start):
    """A point where each camera looks at, one extent ahead."""

    size: float = Field(0.1, gt=0.0, description="standard deviation of its Gaussian, extents")

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        ahead = [view.camera.world_to_camera[2, :3].numpy() for view in scene.train_views]
        count = len(ahead)
        return MorePoints(
            positions=scene.centers + np.stack(ahead),
            colors=np.full((count, 3), 127, dtype=np.uint8),
            sizes=np.full(count, self.size),
            opacities=np.full(count, 0.5),
        )
