"""No exposure: photos are compared as they are."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Scene


class NoExposure(Exposure):
    """Compares renders with photos as they are: all are taken to have the same exposure."""

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image

    @override
    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """Names the option that helps where SfM tracks say that photos differ in exposure."""
        if not any(len(view.seen) for view in scene.train_views):
            return ()
        from crossgrad_plugins.exposures.tracks.gains import deciding_gains

        try:
            gains = deciding_gains(scene)
        except Exception:
            return ()
        if not gains.differ:
            return ()
        return (f"the photos differ in exposure, which --exposure gain models: {gains.evidence}",)
