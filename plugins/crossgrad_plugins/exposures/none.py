"""No exposure: photos are compared as they are."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Scene

#: Photos that are looked at for the remark; evenly spaced among more.
_MOST = 48


class NoExposure(Exposure):
    """Compares renders with photos as they are: all are taken to have the same exposure."""

    @override
    def exposed(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image

    @override
    def remarks(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """Names the option that helps where SfM tracks say that photos differ in exposure."""
        views = scene.train_views
        if not any(len(view.seen) for view in views):
            return ()
        from crossgrad_plugins.exposures.tracks.gains import track_gains

        chosen = views[:: -(-len(views) // _MOST)]
        try:
            gains = track_gains(scene, chosen)
        except Exception:
            return ()
        if not gains.differ:
            return ()
        return (f"the photos differ in exposure, which --exposure gain models: {gains.evidence}",)
