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

    The gains are fitted to the brightness of the training photos at SfM points. `gain` is used if
    the standard deviation of the gains is at least 0.2 stops and at least four times its standard
    error, and if the gains reduce the deviation of points that join different photos by at least 15
    %.
    """

    @override
    def fitted_to(self, scene: Scene) -> Fitted:
        gains = deciding_gains(scene)
        if gains.differ:
            # Import it here, because a run without exposure does not need it.
            from crossgrad_plugins.exposures.gain import Gain

            # The messages of `Gain` contain the evidence.
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
    """Compares renders with photos directly; all photos are assumed to have the same exposure."""

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image

    @override
    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """Name the option that helps if SfM tracks show that photos differ in exposure."""
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
