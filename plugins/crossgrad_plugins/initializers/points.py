"""The points of the scene, without additions."""

from typing_extensions import override

from crossgrad_core.plugin import Initializer, MorePoints, Scene


class SfmPoints(Initializer):
    """Adds no points."""

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        return None
