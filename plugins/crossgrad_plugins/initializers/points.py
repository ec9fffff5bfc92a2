"""The points of the scene and no others."""

from typing_extensions import override

from crossgrad_core.plugin import Initializer, MorePoints, Scene


class SfmPoints(Initializer):
    """Adds nothing."""

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        return None
