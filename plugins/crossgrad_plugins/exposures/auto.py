"""A gain per photo if SfM tracks show that photos differ in exposure, else no exposure."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Fitted, Scene
from crossgrad_plugins.exposures.tracks.gains import (
    LEAST_RATIO,
    LEAST_REDUCTION,
    LEAST_SPREAD,
    deciding_gains,
)


class Auto(Exposure):
    """Uses `gain` if the brightness of SfM tracks requires it, else `none`.

    Gains are fitted to the brightness of SfM points in the training photos. Three conditions select
    `gain`. The standard deviation of the gains is at least 0.2 stops. It is at least four times its
    standard error. The gains reduce the deviation of points that join different photos by at least
    15 %.
    """

    @override
    def fitted_to(self, scene: Scene) -> Fitted:
        gains = deciding_gains(scene)
        if gains.differ:
            # Import the module here, because a run without exposure does not need it.
            from crossgrad_plugins.exposures.gain import Gain

            # The messages of `Gain` show the evidence for this choice.
            return Fitted(Gain(), "gain", ("exposure auto: gain",))
        rule = (
            f"less than {LEAST_SPREAD} stops, {LEAST_RATIO:.0f} standard errors or "
            f"{100 * LEAST_REDUCTION:.0f} %"
        )
        why = gains.evidence if not gains.known.any() else f"{gains.evidence}; {rule}"
        return Fitted(NoExposure(), "none", (f"exposure auto: none; {why}",))

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image


class NoExposure(Exposure):
    """Compares renders with photos directly, as if all photos had the same exposure."""

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image

    @override
    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """Return a message with the option that helps if SfM tracks show different exposures."""
        if not any(len(view.seen) for view in scene.train_views):
            return ()
        from crossgrad_plugins.exposures.tracks.gains import deciding_gains

        try:
            gains = deciding_gains(scene)
        except Exception:
            return ()
        if not gains.differ:
            return ()
        return ((f"the photos differ in exposure, which --exposure gain models: {gains.evidence}"),)
